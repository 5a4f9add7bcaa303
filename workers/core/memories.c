/* Forms with memory, such as delays: they change a signal as a whole, from its past values.
 *
 * A signal is samples between which it is linear, or held; it keeps its first value before and its
 * last value after them. `at` and `out` have room for twice as many samples and one.
 */
#include <math.h>

#include "core.h"

/* The signal as it was some seconds ago. Of samples that fall on one time when it is moved, the
 * last one is kept. */
int64_t core_delay(const double *times, const double *values, size_t n, double seconds, double *at,
                   double *out) {
    size_t count = 0;
    for (size_t i = 0; i < n; i++) {
        if (i + 1 < n && !(times[i + 1] + seconds > times[i] + seconds)) continue;
        at[count] = times[i] + seconds, out[count++] = values[i];
    }
    return (int64_t)count;
}

/* The signal behind a play, which it has to cross whenever it turns: out = clip(out before, s - k,
 * s + k), starting at s. Exact for signals that are linear between their samples: there is a
 * further sample wherever the play is crossed, before which nothing has moved yet. */
int64_t core_backlash(const double *times, const double *values, size_t n, double half_width,
                      double *at, double *out) {
    if (n == 0) return 0;
    double now = values[0];
    size_t count = 1;
    at[0] = times[0], out[0] = now;
    for (size_t i = 1; i < n; i++) {
        const double before = times[i - 1], last = values[i - 1], time = times[i], s = values[i];
        const double low = s - half_width, high = s + half_width;
        double moved = low > now ? low : now;
        if (high < moved) moved = high;
        if (moved != now) {
            const double contact = now + copysign(half_width, s - last);
            const double crossed = before + (time - before) * (contact - last) / (s - last);
            if (before < crossed && crossed < time) at[count] = crossed, out[count++] = now;
        }
        at[count] = time, out[count++] = moved;
        now = moved;
    }
    return (int64_t)count;
}

typedef struct {
    double *at, *out;
    size_t count;
} Samples;

static double append(Samples *s, double time, double value) {
    s->at[s->count] = time, s->out[s->count++] = value;
    return value;
}

/* Follow one straight line, from `start` to `stop`, from the value `out`; where it is caught up
 * with there is a sample too. Returns the value at its end. */
static double follow_line(Samples *s, double out, double begin, double start, double end,
                          double stop, double fastest) {
    const double gap = start - out, slope = (stop - start) / (end - begin);
    if (gap != 0.0) {
        const double way = copysign(1.0, gap), closing = fastest - way * slope;
        if (closing * (end - begin) <= fabs(gap))
            return append(s, end, out + way * fastest * (end - begin));
        const double caught = begin + fabs(gap) / closing;
        start += slope * (caught - begin);
        if (begin < caught && caught < end) append(s, caught, start);
        begin = caught, out = start;
    }
    if (fabs(slope) <= fastest) return append(s, end, stop);
    return append(s, end, out + copysign(fastest, slope) * (end - begin));
}

/* The signal of an actuator that follows it from `out` on, but never changes faster than a rate:
 * out' = clip(s', -r, r) where out = s, else r sign(s - out). Exact; linear between its samples. */
int64_t core_rate_limit(const double *times, const double *values, size_t n, int held, double start,
                        double fastest, double *at, double *out) {
    Samples s = {at, out, 0};
    if (n == 0) return 0;
    append(&s, times[0], start);
    for (size_t i = 0; i + 1 < n; i++)
        start = follow_line(&s, start, times[i], values[i], times[i + 1],
                            held ? values[i] : values[i + 1], fastest);
    const double behind = fabs(values[n - 1] - start), last = times[n - 1] + behind / fastest;
    if (fastest > 0.0 && last > times[n - 1]) append(&s, last, values[n - 1]);
    return (int64_t)s.count;
}
