/* Events of an original for model exchange that this FMU integrates: found between two steps,
 * located on the integrator's interpolant, and handed to the original. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "wrapper.h"

#if ORIGINAL_EXCHANGE
enum { MOST_ITERATIONS = 100 };

fmi2Status note_signs(Instance *c) {
    if (N_INDICATORS == 0) return fmi2OK;
    return c->original.GetEventIndicators(c->original.handle, c->now.indicators, N_INDICATORS);
}

/* In event mode: let the original update its discrete states to the end, and leave the mode. */
fmi2Status iterate_event(Instance *c) {
    fmi2EventInfo info = {fmi2True, fmi2False, fmi2False, fmi2False, fmi2False, 0.0};
    fmi2Status status = fmi2OK;
    int iterations, changed = 0, nominals = 0, j;
    for (iterations = 0; info.newDiscreteStatesNeeded; iterations++) {
        if (iterations == MOST_ITERATIONS)
            return complain(c, fmi2Error, "an event does not come to an end");
        status = c->original.NewDiscreteStates(c->original.handle, &info);
        if (AT_LEAST_DISCARD(status)) return status;
        changed |= info.valuesOfContinuousStatesChanged;
        nominals |= info.nominalsOfContinuousStatesChanged;
        if (info.terminateSimulation) {
            c->now.ended = 1;
            return fmi2Discard;
        }
    }
    c->now.next_event = info.nextEventTimeDefined ? info.nextEventTime : HUGE_VAL;
    status = c->original.EnterContinuousTimeMode(c->original.handle);
    c->now.in_event = 0;
    if (changed && N_STATES > 0 && !AT_LEAST_DISCARD(status))
        status = c->original.GetContinuousStates(c->original.handle, c->now.states, N_STATES);
    if (nominals && N_STATES > 0 && !AT_LEAST_DISCARD(status)) {
        double found[ROOM(N_STATES)];
        status = c->original.GetNominalsOfContinuousStates(c->original.handle, found, N_STATES);
        for (j = 0; j < N_STATES; j++) c->now.atols[j] = SOLVER_ATOL * fabs(found[j]);
    }
    c->now.proposed = 0.0;
    return status;
}

/* At the time where the original stands: to event mode, inputs, event iteration, and back. */
fmi2Status handle_event(Instance *c) {
    fmi2Status status = fmi2OK;
    if (!c->now.in_event) status = c->original.EnterEventMode(c->original.handle);
    if (AT_LEAST_DISCARD(status)) return status;
    c->now.in_event = 1;
    status = write_inputs(c, c->now.time, c->now.states, 1);
    if (!AT_LEAST_DISCARD(status)) status = iterate_event(c);
    if (!AT_LEAST_DISCARD(status)) status = go_to(c, c->now.time, c->now.states);
    if (!AT_LEAST_DISCARD(status)) status = note_signs(c);
    return status;
}

static int crossed(const double *one, const double *other) {
    int j, found = 0;
    for (j = 0; j < N_INDICATORS; j++) found |= (one[j] > 0.0) != (other[j] > 0.0);
    return found;
}

/* Where the first indicator would be zero if all were straight lines, from 0 to 1. */
static double first_zero(const double *low, const double *high) {
    double first = 1.0;
    int j;
    for (j = 0; j < N_INDICATORS; j++)
        if ((low[j] > 0.0) != (high[j] > 0.0))
            first = fmin(first, fabs(low[j]) / (fabs(low[j]) + fabs(high[j])));
    return first;
}

/* One end of the bracket has moved so many times in a row: from the second time on the other end
 * counts half (the Illinois rule; M. Dowell, P. Jarratt, BIT 11 (1971) 168-174). */
static void take(double *moved, const double *found, double *kept, int times) {
    int j;
    for (j = 0; j < N_INDICATORS; j++) {
        moved[j] = found[j];
        if (times > 1) kept[j] *= 0.5;
    }
}

static fmi2Status look(Instance *c, double time, const double *trial, double *indicators) {
    fmi2Status status = go_to(c, time, trial);
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.GetEventIndicators(c->original.handle, indicators, N_INDICATORS);
}

/* Look for a state event in a step that ends at `trial`, where the original stands. `part` becomes
 * the part of the step that is left of it, or 2 if there is none. */
fmi2Status find_event(Instance *c, double step, double stages[][ROOM(N_INNER)], double *trial,
                      double *part) {
    double *low = c->now.indicators, high[ROOM(N_INDICATORS)], found[ROOM(N_INDICATORS)];
    double left = 0.0, right = 1.0, guess, width, at;
    int side = 0, tries = 0;
    fmi2Status status;
    *part = 2.0;
    if (N_INDICATORS == 0) return fmi2OK;
    status = c->original.GetEventIndicators(c->original.handle, found, N_INDICATORS);
    if (AT_LEAST_DISCARD(status)) return status;
    if (!crossed(low, found)) {
        memcpy(low, found, N_INDICATORS * sizeof *low);
        return status;
    }
    memcpy(high, found, sizeof high);
    width = fmin(0.5, 100.0 * DBL_EPSILON * (fabs(c->now.time) + step) / step);
    while (right - left > width) {
        guess = ++tries % 3 == 0 ? 0.5 : first_zero(low, high);
        at = left + fmin(fmax(guess * (right - left), 0.5 * width), right - left - 0.5 * width);
        polynomial(c, step, at, stages, trial);
        status = look(c, c->now.time + at * step, trial, found);
        if (AT_LEAST_DISCARD(status)) return status;
        if (crossed(low, found)) {
            right = at;
            side = side > 0 ? side + 1 : 1;
            take(high, found, low, side);
        } else {
            left = at;
            side = side < 0 ? side - 1 : -1;
            take(low, found, high, -side);
        }
    }
    if (right < 1.0) polynomial(c, step, right, stages, trial);
    *part = right;
    return look(c, c->now.time + right * step, trial, found);
}
#endif
