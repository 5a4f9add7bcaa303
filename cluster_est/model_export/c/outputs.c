/* Effects at outputs: each sees what the ones before it have made of the outputs. */
#include <math.h>
#include <string.h>

#include "wrapper.h"

#if N_OUTPUT_EFFECTS > 0
/* Where the output stands in the row, the coefficient that is its delay or -1, and its states. */
static const struct { int column, delay, first, count; } effects[] = OUTPUT_EFFECTS;
static const fmi2ValueReference recorded[] = ROW_REFERENCES;

static History *history_of(Instance *c, int e) { return &c->histories[N_INPUT_MEMORIES + e]; }

static double result_of(Instance *c, int e, const double *row, const double *raw) {
    double value = row[effects[e].column];
    if (effects[e].delay < 0)
        return output_after(e, c->now.time, c->now.states, row, raw, c->now.coefficients);
    return history_at(history_of(c, e), c->now.time - c->now.coefficients[effects[e].delay],
                      c->now.time, value);
}

static fmi2Status get_row(Instance *c, double *row) {
    return c->original.GetReal(c->original.handle, recorded, N_ROW, row);
}

/* What each effect sees, and in `last` what all of them make of it. */
fmi2Status output_rows(Instance *c, double rows[][ROOM(N_ROW)], double *last) {
    double raw[ROOM(N_RAW)] = {0.0};
    fmi2Status status = get_row(c, last);
    int e;
    take_inputs(c, c->now.time, raw);
    for (e = 0; e < N_OUTPUT_EFFECTS; e++) {
        memcpy(rows[e], last, N_ROW * sizeof *last);
        last[effects[e].column] = result_of(c, e, last, raw);
    }
    return status;
}

fmi2Status begin_outputs(Instance *c) {
    double row[ROOM(N_ROW)], raw[ROOM(N_RAW)] = {0.0};
    fmi2Status status = get_row(c, row);
    int e;
    take_inputs(c, c->now.time, raw);
    for (e = 0; e < N_OUTPUT_EFFECTS; e++) {
        output_begin(e, c->now.time, c->now.states, row, raw, c->now.coefficients);
        row[effects[e].column] = result_of(c, e, row, raw);
    }
    return status;
}

/* Keep what the outputs are at a completed step, or where a communication step begins. */
fmi2Status note_outputs(Instance *c) {
    double last[ROOM(N_ROW)];
    fmi2Status status = output_rows(c, c->now.rows, last);
    int e;
    for (e = 0; e < N_OUTPUT_EFFECTS; e++)
        if (effects[e].delay >= 0)
            history_note(history_of(c, e), c->now.time, c->now.rows[e][effects[e].column], 0.0);
    return status;
}

#if N_OUTPUT_OWN > 0
/* One classic Runge-Kutta step, number n of so many, of an effect's own states. */
static void advance(Instance *c, int e, const double *row, double begin, double length, int n,
                    int steps) {
    double stages[4][ROOM(N_ALL)], trial[ROOM(N_ALL)];
    double between[ROOM(N_ROW)], raw[ROOM(N_RAW)] = {0.0};
    double step = length / steps, *x = c->now.states;
    int stage, j, last = effects[e].first + effects[e].count;
    memcpy(trial, x, sizeof trial);
    for (stage = 0; stage < 4; stage++) {
        double reach = stage == 0 ? 0.0 : (stage == 3 ? 1.0 : 0.5), part = (n + reach) / steps;
        for (j = effects[e].first; stage > 0 && j < last; j++)
            trial[j] = x[j] + reach * step * stages[stage - 1][j];
        for (j = 0; j < N_ROW; j++)
            between[j] = c->now.rows[e][j] + part * (row[j] - c->now.rows[e][j]);
        take_inputs(c, begin + part * length, raw);
        output_inside(e, begin + part * length, trial, between, raw, c->now.coefficients,
                      stages[stage]);
    }
    for (j = effects[e].first; j < last; j++)
        x[j] += step / 6.0 * (stages[0][j] + 2.0 * stages[1][j] + 2.0 * stages[2][j]
                              + stages[3][j]);
}

/* The one own state of an effect over a step in which it follows linearly at a rate, exactly: with
 * the exponential functions phi1 and phi2, whose series is more exact where the exponent is small. */
static void follow(Instance *c, int e, const double *row, double begin, double end, double decay) {
    double first[ROOM(N_ALL)], last[ROOM(N_ALL)], raw[ROOM(N_RAW)] = {0.0};
    double z = -decay * (end - begin), once, twice, *x = c->now.states;
    int j = effects[e].first;
    take_inputs(c, begin, raw);
    output_inside(e, begin, x, c->now.rows[e], raw, c->now.coefficients, first);
    take_inputs(c, end, raw);
    output_inside(e, end, x, row, raw, c->now.coefficients, last);
    if (fabs(z) < 1e-2) {
        once = 1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0)));
        twice = 0.5 + z / 6.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0 * (1.0 + z / 6.0)));
    } else {
        once = expm1(z) / z;
        twice = (once - 1.0) / z;
    }
    x[j] += (end - begin) * (once * first[j] + twice * (last[j] - first[j]));
}

/* As many that a time constant, as it is at either end, has eight, as in the run. */
static int substeps(const Instance *c, int e, const double *row, double begin, double end) {
    double first[ROOM(N_RAW)], last[ROOM(N_RAW)], rate;
    take_inputs(c, begin, first);
    take_inputs(c, end, last);
    rate = fmax(output_rate(e, c->now.rows[e], first, c->now.coefficients),
                output_rate(e, row, last, c->now.coefficients));
    return (int)fmin(fmax(1.0, ceil(8.0 * c->now.step * rate)), 10000.0);
}
#endif

/* Over a communication step, within which the outputs count as linear. */
fmi2Status advance_outputs(Instance *c, double begin, double end) {
#if N_OUTPUT_OWN > 0
    double row[ROOM(N_ROW)], raw[ROOM(N_RAW)] = {0.0};
    fmi2Status status = get_row(c, row);
    int e, n;
    take_inputs(c, end, raw);
    for (e = 0; e < N_OUTPUT_EFFECTS; e++) {
        double decay = output_decay(e, row, raw, c->now.coefficients);
        int steps = effects[e].count > 0 && !(decay > 0.0) ? substeps(c, e, row, begin, end) : 0;
        if (decay > 0.0) follow(c, e, row, begin, end, decay);
        for (n = 0; n < steps; n++) advance(c, e, row, begin, end - begin, n, steps);
        row[effects[e].column] = result_of(c, e, row, raw);
    }
    return status;
#else
    (void)c;
    (void)begin;
    (void)end;
    return fmi2OK;
#endif
}
#else
fmi2Status output_rows(Instance *c, double rows[][ROOM(N_ROW)], double *last) {
    (void)c;
    (void)rows;
    (void)last;
    return fmi2OK;
}
fmi2Status begin_outputs(Instance *c) { return (void)c, fmi2OK; }
fmi2Status note_outputs(Instance *c) { return (void)c, fmi2OK; }
fmi2Status advance_outputs(Instance *c, double begin, double end) {
    return (void)c, (void)begin, (void)end, fmi2OK;
}
#endif
