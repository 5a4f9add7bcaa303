/* The classic Runge-Kutta method of order 4 with a fixed step.
 *
 * The cheapest choice for smooth, non-stiff models whose inputs are sampled more finely than their
 * dynamics. It never checks its own error: compare once with half the step.
 *
 * Reference: W. Kutta, Zeitschrift fuer Mathematik und Physik 46 (1901) 435-453. Dense output of
 * order 3: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section
 * II.6.
 */
#include "exchange.h"

static const double interpolant[4][3] = {
    {1.0, -3.0 / 2, 2.0 / 3}, {0.0, 1.0, -2.0 / 3}, {0.0, 1.0, -2.0 / 3}, {0.0, -1.0 / 2, 2.0 / 3}};
static const DenseOutput dense = {4, 3, interpolant[0]};

/* k of a step from x at `time`, where the FMU is. */
ALWAYS int stages(const Model *c, const Shape s, Work *w, const Interval *a, double time,
                  double h) {
    const size_t n = N_STATES;
    double *const k = c->at.k;
    TRY(derivatives(c, s, k));
    move_states(c, s, 0.5 * h, k);
    TRY(derivatives_at(c, s, w, a, time + 0.5 * h, k + n));
    move_states(c, s, 0.5 * h, k + n);
    TRY(derivatives_at(c, s, w, a, time + 0.5 * h, k + 2 * n));
    move_states(c, s, h, k + 2 * n);
    return derivatives_at(c, s, w, a, time + h, k + 3 * n);
}

/* to = x + h (k1 + 2 k2 + 2 k3 + k4) / 6. */
ALWAYS void sum_stages(const Model *c, const Shape s, double h, double *to) {
    const size_t n = N_STATES;
    const double *restrict const k = c->at.k;
    const double *const x = c->at.x, sixth = h / 6.0;
    if (s.n_states >= 0) {
        double next[MOST_STATES];
        for (size_t j = 0; j < n; j++)
            next[j] = x[j] + sixth * (k[j] + 2.0 * k[n + j] + 2.0 * k[2 * n + j] + k[3 * n + j]);
        memcpy(to, next, n * sizeof *to);
    } else {
        FOR(j, n)
            to[j] = x[j] + sixth * (k[j] + 2.0 * k[n + j] + 2.0 * k[2 * n + j] + k[3 * n + j]);
    }
}

/* One step, or its part up to an event, to *end. Returns the code, EVENT if there is one. */
ALWAYS int step_to_event(Work *w, const Shape s, size_t i, double time, double h, int set_first,
                         Forward *forward, double *end) {
    const Model *c = &w->model;
    const Interval a = interval(c, s, i);
    double part = 2.0;
    *end = time;
    int status = set_first ? set_at(w, i, time, w->x) : OK;
    if (status < DISCARD) status = stages(c, s, w, &a, time, h);
    sum_stages(c, s, h, w->trial);
    if (status < DISCARD && (c->f.completes_steps || c->f.n_indicators > 0))
        status = set_model(c, s, w, time + h);
    if (status < DISCARD && c->f.n_indicators > 0)
        status = find_event(w, i, time, h, dense_output, &dense, &part);
    if (status >= DISCARD) return failed(STEP_FAILED, status);
    if (forward != NULL) {
        status = advance_sensitivities(w, i, time, h, forward);
        if (status >= DISCARD) return failed(SENSITIVITIES_FAILED, status);
    }
    FOR(j, N_STATES) w->x[j] = w->trial[j];
    const int code = complete_step(w);
    *end = time + smaller(part, 1.0) * h;
    return code == FINISHED && part <= 1.0 ? EVENT : code;
}

/* From grid time i to the next, in equal steps from event to event; with sensitivities up to the
 * first event. Returns the code. */
ALWAYS int equal_steps_of(Work *w, const Shape s, size_t i, Stepping *now, Forward *forward) {
    const double last = w->model.times[i + 1], resolution = time_resolution(now->time, last);
    int at_grid = 1;
    for (int64_t repeated = 0;;) {
        const double begin = now->time, end = next_stop(w, last, resolution);
        const int64_t steps =
            end > begin ? n_steps(end - begin, w->batch->settings->step, now->left) : 0;
        if (steps > now->left) return TOO_MANY_STEPS;
        now->left -= steps;
        const double h = (end - begin) / (double)(steps > 0 ? steps : 1);
        int code = FINISHED;
        for (int64_t n = 0; n < steps && code == FINISHED; n++, at_grid = 0)
            code = step_to_event(w, s, i, begin + (double)n * h, h, !at_grid, forward, &now->time);
        if (code == FINISHED && steps > 0) now->time = end;
        if (code == EVENT || (code == FINISHED && now->time >= w->next_event)) {
            if (forward != NULL) return HAS_EVENTS;
            repeated = now->time - begin <= resolution ? repeated + 1 : 0;
            code = handle_event(w, i, i, now->time, repeated);
            at_grid = 1;
        }
        if (code != FINISHED || last - now->time <= resolution) return code;
    }
}

static int equal_steps_2(Work *w, size_t i, Stepping *now) {
    return equal_steps_of(w, (Shape){2, 0, 1, -1, -1}, i, now, NULL);
}

static int equal_steps_2_effects(Work *w, size_t i, Stepping *now) {
    return equal_steps_of(w, (Shape){2, 1, 1, -1, -1}, i, now, NULL);
}

int equal_steps(Work *w, size_t i, Stepping *now, Forward *forward) {
    const Model *c = &w->model;
    if (forward != NULL || c->f.version == 3 || !has_reals(c))
        return equal_steps_of(w, ANY, i, now, forward);
    return c->program ? equal_steps_2_effects(w, i, now) : equal_steps_2(w, i, now);
}

/* From *time to the end of an interval where nothing is asked in between. Returns the status. */
ALWAYS int quiet_steps(const Model *c, const Shape s, Work *w, const Interval *a, double *time,
                       double end, int64_t steps) {
    const double begin = *time, h = (end - begin) / (double)steps;
    for (int64_t n = 0; n < steps; n++) {
        *time = begin + (double)n * h;
        if (n > 0) TRY(set_to_x(c, s, w, a, *time - a->begin, *time));
        TRY(stages(c, s, w, a, *time, h));
        sum_stages(c, s, h, c->at.x);
    }
    return OK;
}

ALWAYS End simulate(Work *w, const double *point, double *y, const Shape s) {
    Own own;
    const Model copy = with_own(&w->model, s, &own), *const c = &copy;
    const double *const t = c->times, longest = w->batch->settings->step;
    const size_t last = c->n_times - 1;
    const int64_t most = w->batch->settings->max_steps;
    const int bounded = w->bound < HUGE_VAL, quiet = is_quiet(c) && most > 0;
    int64_t all_steps = 0;
    Stepping now = {t[0], 0.0, most};
    int code = start_simulation(w, point);
    if (code != FINISHED) return (End){code, now.time, 0};
    take_back(c, s, w);
    double quiet_end = quiet ? quiet_until(w) : -HUGE_VAL;
    for (size_t i = 0;; i++, y += c->n_outputs) {
        if (UNLIKELY(!quiet)) code = jump(c, s, w, i, now.time);
        if (UNLIKELY(code != FINISHED)) return (End){code, now.time, i};
        const Interval a = interval(c, s, i);
        int status = record(c, s, w, &a, now.time, y);
        if (UNLIKELY(status >= DISCARD))
            return (End){failed(OUTPUT_FAILED, status), now.time, i};
        if (bounded && is_above_bound(w, i, y)) return (End){ENDED_EARLY, now.time, i};
        if (i == last) break;
        if (LIKELY(t[i + 1] < quiet_end)) {
            int64_t steps = 1;
            if (LIKELY(longest <= 0.0)) {
                const double h = t[i + 1] - now.time;
                status = stages(c, s, w, &a, now.time, h);
                sum_stages(c, s, h, c->at.x);
            } else {
                steps = n_steps(t[i + 1] - now.time, longest, most);
                if (steps > most) return (End){TOO_MANY_STEPS, now.time, i};
                status = quiet_steps(c, s, w, &a, &now.time, t[i + 1], steps);
            }
            if (UNLIKELY(status >= DISCARD))
                return (End){failed(STEP_FAILED, status), now.time, i};
            now.time = t[i + 1];
            all_steps += steps;
        } else {
            now.left = most;
            hand_over(c, s, w);
            code = equal_steps(w, i, &now, NULL);
            if (code != FINISHED) return (End){code, now.time, i};
            all_steps += most - now.left;
            take_back(c, s, w);
            if (quiet) quiet_end = quiet_until(w);
        }
    }
    c->progress[STEPS] = all_steps;
    return (End){FINISHED, now.time, last};
}

/* ---- a loop for each common shape -------------------------------------------------------- */

LOOP(simulate, any, 0, -1, 0, -1, -1)
LOOP(simulate, fmi2, 2, 0, 1, -1, -1)
LOOP(simulate, fmi2_effects, 2, 1, 1, -1, -1)
LOOP(simulate, fmi3, 3, 0, 1, -1, -1)
#define LOOPS(states, inputs)                                \
    LOOP(simulate, fmi2_##states##_##inputs, 2, 0, 1, states, inputs)  \
    LOOP(simulate, fmi2_##states##_##inputs##_effects, 2, 1, 1, states, inputs)
LOOPS(1, 0) LOOPS(1, 1) LOOPS(2, 0) LOOPS(2, 1) LOOPS(3, 0) LOOPS(3, 1) LOOPS(4, 0) LOOPS(4, 1)

Loop *runge_kutta_loop(const Model *c) {
#define PAIR(states, inputs) \
    {fmi2_##states##_##inputs, fmi2_##states##_##inputs##_effects}
#define ROW(states) {PAIR(states, 0), PAIR(states, 1)}
    static Loop *const shaped[MOST_STATES][2][2] = {ROW(1), ROW(2), ROW(3), ROW(4)};
    const int effects = c->program != NULL;
    const size_t n = c->n_states;
    if (!has_reals(c) || (c->f.version == 3 && effects)) return any;
    if (c->f.version == 3) return fmi3;
    if (n == c->f.n_states && n >= 1 && n <= MOST_STATES && c->n_inputs <= 1)
        return shaped[n - 1][c->n_inputs][effects];
    return effects ? fmi2_effects : fmi2;
}
