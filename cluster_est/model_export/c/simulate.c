/* Co-simulation: from one communication point to the next. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "wrapper.h"

/* Where inputs that are held jump, an original with events is told so by an event. */
#if ORIGINAL_EXCHANGE
static int jumped(const Instance *c) {
    int j;
    for (j = 0; EVENTFUL && j < N_INPUTS; j++) {
        double was = c->now.was[j], is = c->now.seen[j].value;
        if (fabs(is - was) > 1e-9 * (fabs(is) + fabs(was))) return 1;
    }
    return 0;
}

static fmi2Status over(Instance *c, double end, long *steps_left) {
    fmi2Status status = fmi2OK;
    if (c->now.in_event || jumped(c))
        status = handle_event(c);
    else
        status = go_to(c, c->now.time, c->now.states);
    if (!AT_LEAST_DISCARD(status)) status = note_outputs(c);
    if (!AT_LEAST_DISCARD(status)) status = integrate(c, end, steps_left);
    if (!AT_LEAST_DISCARD(status)) status = go_to(c, c->now.time, c->now.states);
    return status;
}
#else
#if N_MOVING > 0 && INTERPOLATES
static const fmi2ValueReference inputs[] = INPUT_REFERENCES;
#endif

#if N_OWN > 0
/* One classic Runge-Kutta step of the effects' own states. */
static void advance(Instance *c, double time, double step) {
    double k[4][ROOM(N_OWN)], trial[ROOM(N_OWN)], raw[ROOM(N_RAW)] = {0.0}, *x = c->now.states;
    int stage, j;
    for (stage = 0; stage < 4; stage++) {
        double reach = stage == 0 ? 0.0 : (stage == 3 ? step : 0.5 * step);
        for (j = 0; j < N_OWN; j++) trial[j] = stage > 0 ? x[j] + reach * k[stage - 1][j] : x[j];
        take_inputs(c, time + reach, raw);
        effects_inside(time + reach, trial, raw, c->now.coefficients, c->now.base, k[stage]);
    }
    for (j = 0; j < N_OWN; j++)
        x[j] += step / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
}
#endif

/* The inputs at a time as the effects make them, which the original is to see. */
static void edit(const Instance *c, double time, double *edited) {
    double raw[ROOM(N_RAW)] = {0.0};
    take_inputs(c, time, raw);
#if HAS_BEFORE
    double varied[ROOM(N_BASE)];
    effects_before(time, c->now.states, raw, c->now.coefficients, c->now.base, edited, varied);
#else
    memcpy(edited, raw, sizeof raw);
#endif
}

/* Bring the own states to the end of a step, and tell the original how fast its inputs change. */
static fmi2Status prepare(Instance *c, double time, double step) {
    double first[ROOM(N_RAW)], last[ROOM(N_RAW)];
    edit(c, time, first);
#if N_OWN > 0
    {
        double rate = effects_rate(c->now.coefficients);
        double most = fmin(fmax(1.0, ceil(8.0 * c->now.step * rate)), 1e4);
        int n, steps = (int)most;
        for (n = 0; n < steps; n++) advance(c, time + n * (step / steps), step / steps);
    }
#endif
    edit(c, time + step, last);
#if N_MOVING > 0 && INTERPOLATES
    {
        fmi2Integer orders[N_MOVING];
        int j;
        for (j = 0; j < N_MOVING; j++) {
            orders[j] = 1;
            last[j] = HAS_BEFORE ? (last[j] - first[j]) / step : c->now.seen[j].slope;
        }
        return c->original.SetRealInputDerivatives(c->original.handle, inputs, N_MOVING, orders,
                                                   last);
    }
#endif
    return fmi2OK;
}

static fmi2Status over(Instance *c, double end, long *steps_left) {
    double begin = c->now.time, length = end - begin, step;
    long steps = SOLVER_STEP > 0.0 ? (long)fmax(1.0, ceil(length / SOLVER_STEP - 1e-9)) : 1, s;
    fmi2Status status = fmi2OK;
    step = length / steps;
    for (s = 0; s < steps && !AT_LEAST_DISCARD(status); s++) {
        double time = begin + s * step;
        if ((*steps_left)-- <= 0) return complain(c, fmi2Error, "a step takes too many steps");
        status = write_inputs(c, time, c->now.states, 1);
        if (s == 0 && !AT_LEAST_DISCARD(status)) status = note_outputs(c);
        if (!AT_LEAST_DISCARD(status)) status = prepare(c, time, step);
        if (!AT_LEAST_DISCARD(status))
            status = c->original.DoStep(c->original.handle, time, step, fmi2True);
    }
    c->now.time = end;
    return status;
}
#endif

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real point, fmi2Real size, fmi2Boolean keeps) {
    Instance *c = component;
    double end = point + size, begin, until;
    long steps_left = MOST_STEPS;
    fmi2Status status = fmi2OK;
    (void)keeps;
    if (!c->simulates || c->now.phase != RUNNING)
        return complain(c, fmi2Error, "fmi2DoStep must follow fmi2ExitInitializationMode");
    c->now.time = point;
    c->now.step = size;
    while (c->now.time < end && !AT_LEAST_DISCARD(status)) {
        begin = c->now.time;
        until = see_inputs(c, begin, end);
        c->now.dirty = 0;
        status = over(c, until, &steps_left);
        if (AT_LEAST_DISCARD(status)) break;
        if (until == end || end - c->now.time <= 16.0 * DBL_EPSILON * fabs(end))
            c->now.time = end;
        status = advance_outputs(c, begin, c->now.time);
        pass_inputs(c, begin, c->now.time);
    }
    memset(c->now.slopes, 0, sizeof c->now.slopes);
    return status;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                       size_t n, const fmi2Integer order[],
                                       const fmi2Real value[]) {
    static const fmi2ValueReference raw[] = RAW_REFERENCES;
    Instance *c = component;
    size_t i;
    int j;
    for (i = 0; i < n; i++) {
        for (j = 0; j < N_RAW && raw[j] != vr[i]; j++) continue;
        if (j == N_RAW || order[i] != 1)
            return complain(c, fmi2Error, "only first derivatives of continuous inputs can be set");
        c->now.slopes[j] = value[i];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                        size_t n, const fmi2Integer order[], fmi2Real value[]) {
    (void)vr, (void)n, (void)order, (void)value;
    return complain(component, fmi2Error, "derivatives of outputs are not to be had");
}

fmi2Status fmi2CancelStep(fmi2Component component) {
    return complain(component, fmi2Error, "no step goes on after fmi2DoStep has returned");
}

fmi2Status fmi2GetStatus(fmi2Component component, fmi2StatusKind kind, fmi2Status *value) {
    (void)kind, (void)value;
    return complain(component, fmi2Discard, "no step goes on after fmi2DoStep has returned");
}

fmi2Status fmi2GetRealStatus(fmi2Component component, fmi2StatusKind kind, fmi2Real *value) {
    Instance *c = component;
    if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
#if ORIGINAL_EXCHANGE
    *value = c->now.time;
    return fmi2OK;
#else
    return c->original.GetRealStatus(c->original.handle, kind, value);
#endif
}

fmi2Status fmi2GetIntegerStatus(fmi2Component component, fmi2StatusKind kind, fmi2Integer *value) {
    (void)component, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, fmi2StatusKind kind, fmi2Boolean *value) {
    Instance *c = component;
    if (kind != fmi2Terminated) return fmi2Discard;
#if ORIGINAL_EXCHANGE
    *value = c->now.ended ? fmi2True : fmi2False;
    return fmi2OK;
#else
    return c->original.GetBooleanStatus(c->original.handle, kind, value);
#endif
}

fmi2Status fmi2GetStringStatus(fmi2Component component, fmi2StatusKind kind, fmi2String *value) {
    (void)component, (void)kind, (void)value;
    return fmi2Discard;
}
