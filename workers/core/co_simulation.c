/* Co-simulation: the FMU integrates itself from one communication point to the next.
 *
 * An FMU that interpolates its inputs is told their slopes. Any other holds each at what it is at
 * the start of a step: where that is too coarse, `Settings.step` shortens the steps. Inputs that
 * effects change are linear within a step. What the FMU computes and effects depend on is read at
 * the beginning of a step and held.
 */
#include "work.h"

/* The effective inputs at a time of an interval of the grid, at the effects' own states. */
static inline void effective_at(Work *w, const Interval *a, double time) {
    const Model *c = &w->model;
    interpolate(c, ANY, a, time - a->begin);
    if (!c->changes_inputs) return;
    hold_seen(w);
    *w->time = time;
    FOR(j, c->n_states) w->trial[j] = w->x[j];
    run_fast(c->program->fast[BEFORE], w->r);
}

int set_effective(Work *w, const Interval *a, double time) {
    const Model *c = &w->model;
    TRY(see_outputs(w));
    effective_at(w, a, time);
    if (c->n_inputs > 0)
        TRY(set_values(&c->f, c->f.version, &c->inputs, w->effective, w->buffer));
    if (c->n_parameters == 0) return OK;
    return set_reals(&c->f, c->f.version, c->parameters, c->n_parameters, w->varied);
}

/* One classic Runge-Kutta step of the effects' own states. */
static void advance_own_states(Work *w, const Interval *a, double time, double h) {
    const Model *c = &w->model;
    const Program *p = c->program;
    const size_t n = c->n_states;
    double *restrict const x = w->x, *restrict const k = w->k;
    for (size_t stage = 0; stage < 4; stage++) {
        const double offset = stage == 0 ? 0.0 : stage == 3 ? h : 0.5 * h;
        if (stage == 0)
            FOR(j, n) w->trial[j] = x[j];
        else
            FOR(j, n) w->trial[j] = x[j] + offset * k[(stage - 1) * n + j];
        interpolate(c, ANY, a, time + offset - a->begin);
        hold_seen(w);
        *w->time = time + offset;
        run_fast(p->fast[AFTER], w->r);
        FOR(j, p->n_sites) k[stage * n + p->sites[j].state] = w->r[p->sites[j].r];
    }
    FOR(j, n) x[j] += h / 6.0 * (k[j] + 2.0 * k[n + j] + 2.0 * k[2 * n + j] + k[3 * n + j]);
}

/* The slopes of the effective inputs over a step, to whose end the effects' own states go. */
static void slopes_over_step(Work *w, const Interval *a, double time, double h) {
    const Model *c = &w->model;
    FOR(j, c->n_inputs) w->input_slopes[j] = -w->effective[j] / h;
    if (c->program->n_sites > 0) {
        const int64_t substeps = substep_count(h, w->fastest_rate);
        const double substep = h / (double)substeps;
        for (int64_t n = 0; n < substeps; n++)
            advance_own_states(w, a, time + (double)n * substep, substep);
    }
    effective_at(w, a, time + h);
    FOR(j, c->n_inputs) w->input_slopes[j] += w->effective[j] / h;
}

/* From grid time i to the next in equal steps, or with effects; the last of several ends at the
 * next time itself. */
RARELY int several_steps(Work *w, size_t i, int64_t steps) {
    const Model *c = &w->model;
    const Interval a = interval(c, ANY, i);
    const double fixed = w->batch->settings->fixed;
    const double h = fixed != 0.0 ? fixed : c->intervals[i] / (double)steps;
    for (int64_t n = 0; n < steps && !w->info.ended; n++) {
        const double time = c->times[i] + (double)n * h;
        const double *slopes = c->slopes + i * c->n_inputs;
        if (n > 0) TRY(set_effective(w, &a, time));
        if (c->changes_inputs) {
            slopes_over_step(w, &a, time, h);
            slopes = w->input_slopes;
        }
        if (c->f.interpolates_inputs && c->continuous.n_reals > 0)
            TRY(set_input_slopes(&c->f, c->inputs.reals, c->inputs.n_reals, w->orders, slopes));
        c->progress[CALLED] = 1;
        const double at = n > 0 && n == steps - 1 ? c->times[i + 1] - h : time;
        TRY(do_step(&c->f, c->f.version, at, h, &w->info));
    }
    return OK;
}

static int failed_step(int status) {
    if (status == DISCARD) return DISCARDED;
    return status == PENDING ? IS_PENDING + IS_FATAL : failed(STEP_FAILED, status);
}

ALWAYS End co_simulate(Work *w, const double *point, double *y, const Shape s) {
    const Model copy = w->model, *const c = &copy;
    const Settings *const settings = w->batch->settings;
    const double *const t = c->times;
    const size_t last = c->n_times - 1;
    const int bounded = w->bound < HUGE_VAL, effects = EFFECTS && c->changes_inputs;
    const int once = settings->step <= 0.0 && settings->fixed == 0.0 && settings->max_steps > 0
                     && !effects;
    int64_t all_steps = 0;
    w->info.ended = 0;
    initial_inputs(w);
    int status = initialise(w, point, settings->fmu_tolerance);
    if (status >= DISCARD) return (End){failed(INITIALISATION, status), t[0], 0};
    if (effects) {
        memset(w->x, 0, c->n_states * sizeof *w->x);
        status = see_outputs(w);
        if (status >= DISCARD) return (End){failed(OUTPUT_FAILED, status), t[0], 0};
        hold_seen(w);
        start_own_states(w);
    }
    for (size_t i = 0;; i++, y += c->n_outputs) {
        if (effects) {
            const Interval a = interval(c, ANY, i);
            status = set_effective(w, &a, t[i]);
        } else if (N_INPUTS > 0) {
            status = set_inputs(c, s, w, c->values + i * N_INPUTS);
        }
        if (LIKELY(status < DISCARD)) status = get_outputs(c, s, w, y);
        if (UNLIKELY(status >= DISCARD)) return (End){failed(OUTPUT_FAILED, status), t[i], i};
        if (bounded && is_above_bound(w, i, y)) return (End){ENDED_EARLY, t[i], i};
        if (i == last) break;
        if (LIKELY(once)) {
            status = one_step(c, s, w, i);
            all_steps++;
        } else {
            const int64_t steps = n_steps(c->intervals[i], settings->step, settings->max_steps);
            if (steps > settings->max_steps) return (End){TOO_MANY_STEPS, t[i], i};
            all_steps += steps;
            status = several_steps(w, i, steps);
        }
        if (UNLIKELY(status >= DISCARD)) return (End){failed_step(status), t[i], i};
        if (FMI == 3 && UNLIKELY(w->info.ended)) /* whatever it says of when */
            return (End){TERMINATED, smaller(larger(t[i], w->info.next_time), t[i + 1]), i};
    }
    c->progress[STEPS] = all_steps;
    return (End){FINISHED, t[last], last};
}

/* ---- a loop for each common shape -------------------------------------------------------- */

LOOP(co_simulate, any, 0, -1, 0, -1, -1)
LOOP(co_simulate, fmi2, 2, 0, 1, -1, -1)
LOOP(co_simulate, fmi2_1, 2, 0, 1, -1, 1)
LOOP(co_simulate, fmi3, 3, 0, 1, -1, -1)

Loop *co_simulation_loop(const Model *c) {
    if (c->program != NULL || !has_reals(c)) return any;
    return c->f.version == 3 ? fmi3 : c->n_inputs == 1 ? fmi2_1 : fmi2;
}
