/* The solvers of the run, for the co-simulation of an original for model exchange.
 *
 * The classic Runge-Kutta method (W. Kutta, Zeitschrift fuer Mathematik und Physik 46 (1901)
 * 435-453) with a fixed step, and Dormand-Prince 5(4) (J. Comput. Appl. Math. 6 (1980) 19-26,
 * doi:10.1016/0771-050X(80)90013-3) with the interpolant of L. F. Shampine, Math. Comp. 46 (1986)
 * 135-150. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "wrapper.h"

#if ORIGINAL_EXCHANGE
enum { MOST_AT_ONCE = 1000 };
#define EVENT 1 /* beside the status: the step ends at an event */

/* What counts as no time at all between two times. */
static double shortest(double time, double last) {
    return 16.0 * DBL_EPSILON * fmax(fabs(time), fabs(last));
}

#if FIXED_STEPS
#define STAGES 4
#define POWERS 3
static const double dense[STAGES][POWERS] = {
    {1.0, -3.0 / 2, 2.0 / 3}, {0.0, 1.0, -2.0 / 3}, {0.0, 1.0, -2.0 / 3}, {0.0, -1.0 / 2, 2.0 / 3}};
#else
#define STAGES 7
#define POWERS 4
static const double nodes[STAGES] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0, 1.0};
static const double weights[STAGES][STAGES - 1] = {
    {0, 0, 0, 0, 0, 0},
    {1.0 / 5, 0, 0, 0, 0, 0},
    {3.0 / 40, 9.0 / 40, 0, 0, 0, 0},
    {44.0 / 45, -56.0 / 15, 32.0 / 9, 0, 0, 0},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729, 0, 0},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656, 0},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};
static const double error_weights[STAGES] = {
    71.0 / 57600, 0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
static const double dense[STAGES][POWERS] = {
    {1, -8048581381.0 / 2820520608, 8663915743.0 / 2820520608, -12715105075.0 / 11282082432},
    {0, 0, 0, 0},
    {0, 131558114200.0 / 32700410799, -68118460800.0 / 10900136933, 87487479700.0 / 32700410799},
    {0, -1754552775.0 / 470086768, 14199869525.0 / 1410260304, -10690763975.0 / 1880347072},
    {0, 127303824393.0 / 49829197408, -318862633887.0 / 49829197408,
     701980252875.0 / 199316789632},
    {0, -282668133.0 / 205662961, 2019193451.0 / 616988883, -1453857185.0 / 822651844},
    {0, 40617522.0 / 29380423, -110615467.0 / 29380423, 69997945.0 / 29380423}};
#endif

/* The states within a step, which began at the instance's. */
void polynomial(const Instance *c, double step, double part, double stages[][ROOM(N_INNER)],
                double *trial) {
    int j, stage, power;
    for (j = 0; j < N_INNER; j++) {
        double total = 0.0;
        for (stage = 0; stage < STAGES; stage++) {
            double weight = 0.0;
            for (power = POWERS - 1; power >= 0; power--)
                weight = (weight + dense[stage][power]) * part;
            total += weight * stages[stage][j];
        }
        trial[j] = c->now.states[j] + step * total;
    }
}

/* Take over a step, or its part up to an event, and tell the original. */
static fmi2Status accept(Instance *c, const double *trial, double time, double part, int *event) {
    fmi2Status status = fmi2OK;
    *event = part <= 1.0;
    memcpy(c->now.states, trial, N_INNER * sizeof *trial);
    c->now.time = time;
#if COMPLETES_STEPS
    {
        fmi2Boolean wants = fmi2False, ends = fmi2False;
        status = c->original.CompletedIntegratorStep(c->original.handle, fmi2True, &wants, &ends);
        if (wants) *event = EVENT;
        if (ends) {
            c->now.ended = 1;
            return fmi2Discard;
        }
    }
#endif
    return status;
}

#if FIXED_STEPS
static fmi2Status to_next_event(Instance *c, double last, int *event, long *steps_left) {
    double k[STAGES][ROOM(N_INNER)], trial[ROOM(N_INNER)], *x = c->now.states;
    double begin = c->now.time, length = last - begin, step, part;
    long steps = SOLVER_STEP > 0.0 ? (long)fmax(1.0, ceil(length / SOLVER_STEP - 1e-9)) : 1, s;
    fmi2Status status = fmi2OK;
    step = length / steps;
    for (s = 0; s < steps && !*event; s++) {
        double time = begin + s * step, reach;
        int j, stage;
        if ((*steps_left)-- <= 0) return complain(c, fmi2Error, "a step takes too many steps");
        c->now.time = time;
        status = derivative(c, time, x, s > 0, k[0]);
        for (stage = 1; stage < STAGES && !AT_LEAST_DISCARD(status); stage++) {
            reach = stage == 3 ? step : 0.5 * step;
            for (j = 0; j < N_INNER; j++) trial[j] = x[j] + reach * k[stage - 1][j];
            status = derivative(c, time + reach, trial, 1, k[stage]);
        }
        if (AT_LEAST_DISCARD(status)) return status;
        for (j = 0; j < N_INNER; j++)
            trial[j] = x[j] + step / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
        if (COMPLETES_STEPS || N_INDICATORS > 0) status = go_to(c, time + step, trial);
        if (!AT_LEAST_DISCARD(status)) status = find_event(c, step, k, trial, &part);
        if (AT_LEAST_DISCARD(status)) return status;
        status = accept(c, trial, time + fmin(part, 1.0) * step, part, event);
        if (AT_LEAST_DISCARD(status)) return status;
    }
    if (!*event) c->now.time = last;
    return status;
}
#else
/* Six stages after the first, into `trial`. The step meets the tolerance if `error` is at most 1.
 */
static fmi2Status try_step(Instance *c, double step, double k[][ROOM(N_INNER)], double *trial,
                           double *error) {
    const double *x = c->now.states;
    double total = 0.0;
    fmi2Status status = fmi2OK;
    int stage, before, j;
    for (stage = 1; stage < STAGES && !AT_LEAST_DISCARD(status); stage++) {
        for (j = 0; j < N_INNER; j++) {
            double slope = 0.0;
            for (before = 0; before < stage; before++)
                slope += weights[stage][before] * k[before][j];
            trial[j] = x[j] + step * slope;
        }
        status = derivative(c, c->now.time + nodes[stage] * step, trial, 1, k[stage]);
    }
    for (j = 0; j < N_INNER; j++) {
        double estimate = 0.0, scale;
        for (stage = 0; stage < STAGES; stage++) estimate += error_weights[stage] * k[stage][j];
        scale = c->now.atols[j] + SOLVER_RTOL * fmax(fabs(x[j]), fabs(trial[j]));
        total += (step * estimate / scale) * (step * estimate / scale);
    }
    *error = sqrt(total / (N_INNER > 0 ? N_INNER : 1));
    return status;
}

/* By how much to change the step after a try. */
static double factor(fmi2Status status, double error) {
    if (AT_LEAST_DISCARD(status) || !isfinite(error)) return 0.2;
    return error == 0.0 ? 5.0 : fmin(5.0, fmax(0.2, 0.9 * pow(error, -0.2)));
}

/* A hundredth of the time in which the states would change by their own scale. */
static double first_step(const Instance *c, const double *slopes) {
    double size = 0.0, speed = 0.0;
    int j;
    for (j = 0; j < N_INNER; j++) {
        double scale = c->now.atols[j] + SOLVER_RTOL * fabs(c->now.states[j]);
        size += (c->now.states[j] / scale) * (c->now.states[j] / scale);
        speed += (slopes[j] / scale) * (slopes[j] / scale);
    }
    return size < 1e-10 || speed < 1e-10 ? 1e-6 : 0.01 * sqrt(size / speed);
}

static fmi2Status to_next_event(Instance *c, double last, int *event, long *steps_left) {
    double k[STAGES][ROOM(N_INNER)], trial[ROOM(N_INNER)];
    double close = shortest(c->now.time, last), *proposed = &c->now.proposed;
    fmi2Status status = derivative(c, c->now.time, c->now.states, 0, k[0]);
    if (AT_LEAST_DISCARD(status)) return status;
    if (*proposed == 0.0) *proposed = first_step(c, k[0]);
    if (!(*proposed >= close)) *proposed = close;
    while ((*steps_left)-- > 0) {
        double remaining = last - c->now.time, step, error, wanted, part = 2.0, time;
        int final;
        if (SOLVER_STEP > 0.0) *proposed = fmin(*proposed, SOLVER_STEP);
        final = *proposed >= remaining * (1.0 - 1e-10);
        step = final ? remaining : fmin(*proposed, 0.5 * remaining);
        status = try_step(c, step, k, trial, &error);
        if (!AT_LEAST_DISCARD(status) && error <= 1.0)
            status = find_event(c, step, k, trial, &part);
        if (status >= fmi2Error) return status;
        wanted = step * factor(status, error);
        if (AT_LEAST_DISCARD(status) || !(error <= 1.0)) {
            *proposed = wanted;
            if (wanted < close) return complain(c, fmi2Error, "the solver's step became too small");
            continue;
        }
        memcpy(k[0], k[STAGES - 1], sizeof k[0]);
        time = final && part > 1.0 ? last : c->now.time + step * fmin(part, 1.0);
        status = accept(c, trial, time, part, event);
        *proposed = final ? fmax(*proposed, wanted) : wanted;
        if (AT_LEAST_DISCARD(status) || *event || final) return status;
    }
    return complain(c, fmi2Error, "a step takes too many steps of the solver");
}
#endif

/* From where the original stands to a time, from event to event. */
fmi2Status integrate(Instance *c, double last, long *steps_left) {
    double close = shortest(c->now.time, last);
    int still = 0;
    for (;;) {
        double begin = c->now.time, end = fmin(last, c->now.next_event);
        int event = 0;
        fmi2Status status = fmi2OK;
        if (fabs(c->now.next_event - last) <= close) end = c->now.next_event;
        if (end > begin) status = to_next_event(c, end, &event, steps_left);
        if (AT_LEAST_DISCARD(status)) return status;
        if (event || c->now.time >= c->now.next_event) {
            still = c->now.time - begin <= close ? still + 1 : 0;
            if (still > MOST_AT_ONCE)
                return complain(c, fmi2Error, "there are endless events at one time");
            status = go_to(c, c->now.time, c->now.states);
            if (!AT_LEAST_DISCARD(status)) status = handle_event(c);
            if (AT_LEAST_DISCARD(status)) return status;
        }
        if (last - c->now.time <= close) return status;
    }
}
#endif
