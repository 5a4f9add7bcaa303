/* Co-simulation, which finds its events by itself, and FMU states. */
#include <stdlib.h>
#include <string.h>

#include "core.h"

enum { MAX_EVENTS = 10000 }; /* in one step */

/* One classic Runge-Kutta step of size h from `start`. */
static int runge_kutta(Model *m, const State *start, double h)
{
    static const double NODE[] = {0.0, 0.5, 0.5, 1.0};
    static const double WEIGHT[] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    double x[MAX_STATES], at[MAX_STATES], k[MAX_STATES] = {0.0}, mean[MAX_STATES] = {0.0};
    const size_t n = count_states(m);
    m->state = *start;
    m->state.phase = CONTINUOUS_TIME;
    if (core_get_states(m, "step", x, n) != OK)
        return ERROR;
    for (int stage = 0; stage < 4; stage++) {
        move_inputs(m, start, NODE[stage] * h);
        for (size_t i = 0; i < n; i++)
            at[i] = x[i] + NODE[stage] * h * k[i];
        if (core_set_states(m, "step", at, n) != OK || core_get_derivatives(m, "step", k, n) != OK)
            return ERROR;
        for (size_t i = 0; i < n; i++)
            mean[i] += WEIGHT[stage] * k[i];
    }
    for (size_t i = 0; i < n; i++)
        at[i] = x[i] + h * mean[i];
    return core_set_states(m, "step", at, n);
}

/* A step from `start` that says whether an event indicator changed its sign. */
static int step_and_look(Model *m, const State *start, const double z_before[], double h,
                         bool *changed)
{
    double z[N_INDICATORS + 1];
    *changed = false;
    if (runge_kutta(m, start, h) != OK || core_get_indicators(m, "step", z, N_INDICATORS) != OK)
        return ERROR;
    for (int i = 0; i < N_INDICATORS; i++)
        *changed = *changed || (z[i] > 0.0) != (z_before[i] > 0.0);
    return OK;
}

/* A step of at most h that ends at the first state event; bisection finds it. */
static int step_to_event(Model *m, double h, bool *event)
{
    double z[N_INDICATORS + 1], low = 0.0, high = h;
    bool changed;
    State start = m->state;
    start.phase = m->state.phase = CONTINUOUS_TIME;
    if (core_get_indicators(m, "step", z, N_INDICATORS) != OK ||
        step_and_look(m, &start, z, h, event) != OK)
        return ERROR;
    if (!*event)
        return OK;
    for (int i = 0; i < 50; i++) {
        const double middle = 0.5 * (low + high);
        if (step_and_look(m, &start, z, middle, &changed) != OK)
            return ERROR;
        *(changed ? &high : &low) = middle;
    }
    return step_and_look(m, &start, z, high, &changed);
}

static int integrate(Model *m, double end)
{
    int events = 0;
    while (M(time) < end && !m->state.ended) {
        const double target = fmin(end, m->state.next_event);
        const double left = target - M(time);
        const bool last = left <= MAX_STEP * (1.0 + 1e-9);
        bool state_event, step_event;
        if (step_to_event(m, last ? left : MAX_STEP, &state_event) != OK)
            return ERROR;
        if (last && !state_event)
            M(time) = target;
        if (core_completed_step(m, "step", &step_event) != OK)
            return ERROR;
        if (!state_event && !step_event && M(time) < m->state.next_event)
            continue;
        if (settle(m, "step") != OK)
            return ERROR;
        if (++events == MAX_EVENTS)
            return error(m, "step: %d events until %.9g, which do not end", events, M(time));
    }
    return refresh(m);
}

static int check_step(const Model *m, const char *function, double point, double step)
{
    if (require(m, STEPPING, function) != OK)
        return ERROR;
    if (m->state.ended)
        return error(m, "%s: the model has asked for the end of the simulation", function);
    if (!(step > 0.0) || !isfinite(step))
        return error(m, "%s: the step size must be positive, is %g", function, step);
    if (FIXED_STEP > 0.0 && fabs(step - FIXED_STEP) > 1e-9 * FIXED_STEP)
        return error(m, "%s: the step size must be %g, is %g", function, FIXED_STEP, step);
    const double unit = model_step_unit();
    if (unit > 0.0 && step != unit * round(step / unit))
        return error(m, "%s: the step size must be a multiple of %g, is %.17g", function, unit,
                     step);
    if (step > model_longest_step())
        return error(m, "%s: no convergence at time %g", function, point + step);
    if (!(fabs(point - M(time)) <= 1e-8 * (1.0 + fabs(M(time)))))
        return error(m, "%s: the step begins at %g, the model is at %g", function, point, M(time));
    if (earlier(m->state.stop, point + step))
        return error(m, "%s: the step ends after the stop time %g", function, m->state.stop);
    return OK;
}

int core_do_step(Model *m, const char *function, double point, double step)
{
    if (check_step(m, function, point, step) != OK)
        return ERROR;
    M(time) = point; /* the caller's clock rules: differences in rounding must not add up */
    const State start = m->state;
    const int status = integrate(m, point + step);
    if (status != OK) {
        m->state = start;
        return ERROR;
    }
    memset(m->state.slope, 0, sizeof m->state.slope);
    m->state.phase = STEPPING;
    return m->state.ended ? DISCARD : OK;
}

/* ---- FMU states ---------------------------------------------------------------------------- */

int core_get_state(Model *m, const char *function, void **saved)
{
    if (*saved == NULL)
        *saved = malloc(sizeof(State));
    if (*saved == NULL)
        return error(m, "%s: out of memory", function);
    memcpy(*saved, &m->state, sizeof(State));
    return OK;
}

int core_set_state(Model *m, const char *function, const void *saved)
{
    if (saved == NULL)
        return error(m, "%s: no state given", function);
    memcpy(&m->state, saved, sizeof(State));
    return OK;
}

int core_serialize(Model *m, const char *function, const void *saved, void *bytes, size_t size)
{
    if (check_size(m, size, sizeof(State), function) != OK)
        return ERROR;
    memcpy(bytes, saved, sizeof(State));
    return OK;
}

int core_deserialize(Model *m, const char *function, const void *bytes, size_t size, void **saved)
{
    if (check_size(m, size, sizeof(State), function) != OK)
        return ERROR;
    if (*saved == NULL)
        *saved = malloc(sizeof(State));
    if (*saved == NULL)
        return error(m, "%s: out of memory", function);
    memcpy(*saved, bytes, sizeof(State));
    return OK;
}
