/* Telling the original where it is, with inputs and parameters as the effects make them. */
#include <math.h>
#include <string.h>

#include "wrapper.h"

#if N_INPUTS > 0
static const fmi2ValueReference inputs[] = INPUT_REFERENCES;
#endif
#if N_BASE > 0
static const fmi2ValueReference varied_references[] = BASE_REFERENCES;
#endif

static fmi2Status worse(fmi2Status one, fmi2Status other) { return one > other ? one : other; }

/* The inputs behind delays and backlashes, at a time within the step. */
void take_inputs(const Instance *c, double time, double *raw) {
    int j;
    for (j = 0; j < N_RAW; j++)
        raw[j] = c->now.seen[j].value + (time - c->now.seen[j].since) * c->now.seen[j].slope;
}

/* Hand over the inputs and varied parameters; those inputs that may jump alone only if `all`. */
fmi2Status write_inputs(Instance *c, double time, const double *states, int all) {
    double raw[ROOM(N_RAW)] = {0.0};
    fmi2Status status = fmi2OK;
    size_t count = all ? N_INPUTS : N_MOVING;
    take_inputs(c, time, raw);
#if HAS_BEFORE
    double edited[ROOM(N_RAW)], varied[ROOM(N_BASE)];
    effects_before(time, states, raw, c->now.coefficients, c->now.base, edited, varied);
#else
    const double *edited = raw;
    (void)states;
#endif
#if N_INPUTS > 0
    if (count > 0) status = c->original.SetReal(c->original.handle, inputs, count, edited);
#else
    (void)edited;
    (void)count;
#endif
#if N_BASE > 0
    if (!AT_LEAST_DISCARD(status) && c->now.phase != INITIALISING)
        status = worse(status, c->original.SetReal(c->original.handle, varied_references, N_BASE,
                                                   varied));
#endif
    return status;
}

/* The inputs that the original is initialised with. Its states are not known yet and count as 0. */
fmi2Status first_inputs(Instance *c) {
    double raw[ROOM(N_RAW)] = {0.0};
    sample_inputs(c);
    take_inputs(c, c->now.time, raw);
    memset(c->now.states, 0, sizeof c->now.states);
    effects_begin(c->now.time, c->now.states, raw, c->now.coefficients, c->now.base);
    c->now.dirty = 0;
    return write_inputs(c, c->now.time, c->now.states, 1);
}

/* Tell the original the inputs, if it does not know them yet. */
fmi2Status sync(Instance *c) {
    if (!c->now.dirty || c->now.phase == INSTANTIATED) return fmi2OK;
    if (c->now.phase == INITIALISING) return first_inputs(c);
    c->now.dirty = 0;
    if (c->simulates)
        see_inputs(c, c->now.time, HUGE_VAL);
    else
        sample_inputs(c);
    return write_inputs(c, c->now.time, c->now.states,
                        !ORIGINAL_EXCHANGE || c->now.phase == EVENTS || c->now.in_event);
}

/* Move the original to a time and states; the inputs follow from the time. */
fmi2Status go_to(Instance *c, double time, const double *states) {
    fmi2Status status = c->original.SetTime(c->original.handle, time);
    if (N_STATES > 0 && !AT_LEAST_DISCARD(status))
        status = worse(status,
                       c->original.SetContinuousStates(c->original.handle, states, N_STATES));
    if (AT_LEAST_DISCARD(status)) return status;
    return worse(status, write_inputs(c, time, states, 0));
}

/* dx/dt of the original's states and of those of the effects inside. */
fmi2Status derivative(Instance *c, double time, const double *states, int moved, double *result) {
    fmi2Status status = moved ? go_to(c, time, states) : fmi2OK;
    double raw[ROOM(N_RAW)] = {0.0};
    if (N_STATES > 0 && !AT_LEAST_DISCARD(status))
        status = worse(status, c->original.GetDerivatives(c->original.handle, result, N_STATES));
    take_inputs(c, time, raw);
    effects_inside(time, states, raw, c->now.coefficients, c->now.base, result);
    return status;
}

/* Start the own states, once the original's are known. */
void begin_own_states(Instance *c) {
    double raw[ROOM(N_RAW)] = {0.0};
    take_inputs(c, c->now.time, raw);
    effects_begin(c->now.time, c->now.states, raw, c->now.coefficients, c->now.base);
}

/* In model exchange: dx/dt of every state, where the original stands. */
fmi2Status all_derivatives(Instance *c, double *result) {
    fmi2Status status = sync(c);
    if (AT_LEAST_DISCARD(status)) return status;
    if (!HAS_BEFORE && !c->simulates) sample_inputs(c);
    status = worse(status, derivative(c, c->now.time, c->now.states, 0, result));
#if N_OUTPUT_OWN > 0
    if (!AT_LEAST_DISCARD(status)) {
        double rows[ROOM(N_OUTPUT_EFFECTS)][ROOM(N_ROW)], last[ROOM(N_ROW)];
        double raw[ROOM(N_RAW)] = {0.0};
        int e;
        status = worse(status, output_rows(c, rows, last));
        take_inputs(c, c->now.time, raw);
        for (e = 0; e < N_OUTPUT_EFFECTS; e++)
            output_inside(e, c->now.time, c->now.states, rows[e], raw, c->now.coefficients,
                          result);
    }
#endif
    return status;
}
