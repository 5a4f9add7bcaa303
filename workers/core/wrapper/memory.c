/* Delays, backlashes and limited rates: what a signal gives depends on what it was before. */
#include <stdlib.h>

#include "wrapper.h"

/* What counts as no time at all: a kink that is nearer than this is here. */
static double instant(double time) { return 1e-12 * (fabs(time) + 1e-3); }

void history_clear(History *history) {
    free(history->segments);
    memset(history, 0, sizeof *history);
}

int history_copy(History *to, const History *from) {
    Segment *segments = NULL;
    if (from->count > 0) {
        segments = malloc(from->count * sizeof *segments);
        if (segments == NULL) return -1;
        memcpy(segments, from->segments, from->count * sizeof *segments);
    }
    free(to->segments);
    to->segments = segments;
    to->count = to->capacity = from->count;
    return 0;
}

/* From a time on the signal is this; what was said of that time before no longer counts. */
int history_note(History *history, double time, double value, double slope) {
    while (history->count > 0 && history->segments[history->count - 1].since >= time)
        history->count--;
    if (history->count == history->capacity) {
        const size_t capacity = history->capacity == 0 ? 64 : 2 * history->capacity;
        Segment *segments = realloc(history->segments, capacity * sizeof *segments);
        if (segments == NULL) return -1;
        history->segments = segments;
        history->capacity = capacity;
    }
    history->segments[history->count++] = (Segment){time, value, slope};
    return 0;
}

/* The number of segments that begin at a time or before. */
static size_t begun(const History *history, double time) {
    size_t low = 0, high = history->count;
    while (low < high) {
        const size_t middle = low + (high - low) / 2;
        if (history->segments[middle].since <= time)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* A sampled signal, linear from each sample to the next, and from the last to the value now. */
double history_at(const History *history, double at, double now, double value) {
    const size_t n = begun(history, at);
    if (history->count == 0) return value;
    if (n == 0) return history->segments[0].value;
    const Segment from = history->segments[n - 1];
    const Segment to = n < history->count ? history->segments[n] : (Segment){now, value, 0.0};
    if (!(to.since > from.since)) return to.value;
    return from.value
           + (fmin(at, to.since) - from.since) / (to.since - from.since) * (to.value - from.value);
}

/* Whether a signal goes on as it did, so that nothing need be noted. */
static int goes_on(const History *history, Segment given) {
    if (history->count == 0) return 0;
    const Segment *last = history->segments + history->count - 1;
    if (last->slope != given.slope || last->since >= given.since) return 0;
    const double line = last->value + last->slope * (given.since - last->since);
    return fabs(line - given.value) <= 1e-12 * (fabs(line) + fabs(given.value));
}

/* The delayed signal, and when its slope changes next. */
static Segment delayed(History *history, Segment given, double delay, double *next) {
    if (!goes_on(history, given)
        && history_note(history, given.since, given.value, given.slope) != 0) {
        history->is_cut = 1;
        return given;
    }
    const size_t n = begun(history, given.since - delay + instant(given.since));
    if (n < history->count) *next = fmin(*next, history->segments[n].since + delay);
    if (n == 0) return (Segment){given.since, history->segments[0].value, 0.0};
    const Segment then = history->segments[n - 1];
    const double passed = fmax(given.since - delay - then.since, 0.0);
    return (Segment){given.since, then.value + then.slope * passed, then.slope};
}

/* The signal behind a play, which moves once the play is crossed. */
static Segment played(double *out, Segment given, double half_width, double *next) {
    *out = fmin(fmax(*out, given.value - half_width), given.value + half_width);
    const double way = given.slope > 0.0 ? 1.0 : -1.0, speed = fabs(given.slope);
    const double left = way * (*out + way * half_width - given.value);
    if (speed == 0.0 || !(left > instant(given.since) * speed))
        return (Segment){given.since, *out, given.slope};
    *next = fmin(*next, given.since + left / speed);
    return (Segment){given.since, *out, 0.0};
}

/* The signal that follows at a limited rate, until it has caught up. */
static Segment limited(double *out, Segment given, double fastest, double *next) {
    const double gap = given.value - *out, way = gap > 0.0 ? 1.0 : -1.0;
    const double closing = fastest - way * given.slope;
    const double none = instant(given.since) * (fabs(given.slope) + fastest)
                        + 1e-13 * fabs(given.value);
    if (isinf(fastest) || fabs(gap) <= none) {
        *out = given.value;
        const double slope = smaller(larger(given.slope, -fastest), fastest);
        return (Segment){given.since, given.value, slope};
    }
    if (closing > 0.0) *next = fmin(*next, given.since + fabs(gap) / closing);
    return (Segment){given.since, *out, way * fastest};
}

/* What a backlash or a limited rate gives for a sample, from what it gave last. */
static double sampled(const Instance *c, size_t j, double value) {
    const Memory *m = c->table.memories + j;
    const double size = c->coefficients[m->coefficient], out = c->play[j];
    if (!c->now.begun) return m->kind == RATE_LIMIT_FROM_REST && !isinf(size) ? 0.0 : value;
    if (m->kind == BACKLASH) return fmin(fmax(out, value - size), value + size);
    const double most = size * fmax(c->now.time - c->noted[j], 0.0);
    return isnan(most) ? value : fmin(fmax(value, out - most), out + most);
}

static double remembered(const Instance *c, size_t j, double value) {
    const Memory *m = c->table.memories + j;
    if (m->kind != DELAY) return sampled(c, j, value);
    const double size = c->coefficients[m->coefficient];
    return history_at(&c->histories[j], c->now.time - size, c->now.time, value);
}

/* A history that could not be kept whole is none: what follows from it would be another signal. */
int is_remembered(const Instance *c) {
    for (size_t j = 0; j < c->n_histories; j++)
        if (c->histories[j].is_cut) return complain(c, ERROR, "there is no memory left");
    return OK;
}

/* In co-simulation: the inputs from a time on, with their slopes, as the effects see them. Returns
 * until when this holds, at most `end`. */
double see_memories(Instance *c, double time, double end) {
    const Table *t = &c->table;
    double next = end;
    c->times[0] = time;
    FOR(j, t->n_raw) c->seen[j] = c->raw[j], c->seen_slopes[j] = c->slopes[j];
    for (size_t j = 0; j < t->n_memories; j++) {
        const Memory *m = t->memories + j;
        const double size = c->coefficients[m->coefficient];
        Segment seen = {time, c->seen[m->column], c->seen_slopes[m->column]};
        if (m->kind == BACKLASH)
            seen = played(&c->play[j], seen, size, &next);
        else if (m->kind == DELAY)
            seen = delayed(&c->histories[j], seen, size, &next);
        else
            seen = limited(&c->play[j], seen, size, &next);
        c->seen[m->column] = seen.value, c->seen_slopes[m->column] = seen.slope;
        c->moves[j] = seen.slope;
    }
    return next < end - instant(end) ? next : end;
}

/* The inputs go along their lines from one time to another. */
void pass_inputs(Instance *c, double begin, double end) {
    const Table *t = &c->table;
    const double length = end - begin;
    if (c->facts->eventful)
        FOR(j, t->n_raw) c->was[j] = c->seen[j] + (end - c->times[0]) * c->seen_slopes[j];
    FOR(j, t->n_raw) c->raw[j] += c->slopes[j] * length;
    if (LIKELY(t->n_memories == 0)) {
        c->times[0] = end; /* what is seen has moved along */
        return;
    }
    for (size_t j = 0; j < t->n_memories; j++)
        if (t->memories[j].kind != DELAY) c->play[j] += c->moves[j] * (end - begin);
}

/* In model exchange: the inputs at this time, of which nothing is known but samples. */
void sample_inputs(Instance *c) {
    const Table *t = &c->table;
    c->times[0] = c->now.time;
    if (t->n_memories == 0) return;
    FOR(j, t->n_raw) c->seen[j] = c->raw[j], c->seen_slopes[j] = 0.0;
    for (size_t j = 0; j < t->n_memories; j++) {
        double *value = &c->seen[t->memories[j].column];
        *value = remembered(c, j, *value);
    }
}

/* In model exchange: keep the inputs at a completed step. Effects at one input follow each
 * other. */
void note_inputs(Instance *c) {
    const Table *t = &c->table;
    if (t->n_memories == 0) return;
    memcpy(c->seen, c->raw, t->n_raw * sizeof *c->seen);
    for (size_t j = 0; j < t->n_memories; j++) {
        double *here = &c->seen[t->memories[j].column];
        const double given = *here;
        *here = remembered(c, j, given);
        if (t->memories[j].kind == DELAY) {
            if (history_note(&c->histories[j], c->now.time, given, 0.0) != 0)
                c->histories[j].is_cut = 1;
        } else {
            c->play[j] = *here;
            c->noted[j] = c->now.time;
        }
    }
}
