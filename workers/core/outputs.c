/* Effects at outputs: applied to recorded outputs after a simulation.
 *
 * An own state that follows signals linearly, x' = g(t) - a x with g linear between two times of
 * the grid, is advanced exactly, in one step, by an exponential integrator (M. Hochbruck, A.
 * Ostermann, Acta Numerica 19 (2010) 209-286, doi:10.1017/S0962492910000048). Others are advanced
 * by Runge-Kutta substeps, eight for each time constant.
 *
 * The program's states are the effect's own, its inputs those of the grid and the outputs behind
 * them, and its one effective parameter is the output; between times of the grid all are linear.
 */
#include <stdlib.h>

#include "elementary.h"
#include "work.h"

/* Inputs and outputs at a part of the interval after grid time i, and the time. */
static void set_signals(OutputRun *run, size_t i, double part) {
    const Record *a = run->record;
    const size_t next = i + 1 < a->n_times ? i + 1 : i;
    const double length = a->times[next] - a->times[i];
    double *u = run->r + run->p->first_input, *y = u + a->n_inputs;
    for (size_t j = 0; j < a->n_inputs; j++)
        u[j] = a->values[i * a->n_inputs + j] + part * length * a->slopes[i * a->n_inputs + j];
    const double *now = a->outputs + i * a->n_outputs, *then = a->outputs + next * a->n_outputs;
    for (size_t j = 0; j < a->n_outputs; j++) y[j] = now[j] + part * (then[j] - now[j]);
    run->r[0] = a->times[i] + part * length;
}

/* Derivatives of the own states x, with the signals that are set. */
static void slopes(OutputRun *run, const double *x, double *dx) {
    const Program *p = run->p;
    memmove(run->r + 1, x, p->n_own * sizeof *x);
    run_fast(p->fast[AFTER], run->r);
    for (uint32_t j = 0; j < p->n_sites; j++) dx[p->sites[j].state] = run->r[p->sites[j].r];
}

/* Over the interval after grid time i, where the one own state follows linearly. */
static void follow(OutputRun *run, size_t i) {
    const Record *a = run->record;
    const double length = a->times[i + 1] - a->times[i], z = -a->decay * length;
    double first, last, once, twice;
    set_signals(run, i, 0.0);
    slopes(run, run->x, &first);
    set_signals(run, i, 1.0);
    run->r[0] = a->times[i + 1];
    slopes(run, run->x, &last);
    if (fabs(z) < 1e-2) { /* a series is more exact than a difference */
        once = 1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0)));
        twice = 0.5 + z / 6.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0 * (1.0 + z / 6.0)));
    } else {
        once = ce_expm1(z) / z;
        twice = (once - 1.0) / z;
    }
    run->x[0] += length * (once * first + twice * (last - first));
}

/* Runge-Kutta substep n of those after grid time i. */
static void substep(OutputRun *run, size_t i, int64_t n, int64_t substeps) {
    const size_t count = run->p->n_own;
    const Record *a = run->record;
    const double h = (a->times[i + 1] - a->times[i]) / (double)substeps;
    double *x = run->x, *trial = run->r + 1;
    for (int stage = 0; stage < 4; stage++) {
        const double at = stage == 0 ? 0.0 : stage == 3 ? 1.0 : 0.5;
        for (size_t j = 0; j < count; j++)
            trial[j] = stage > 0 ? x[j] + at * h * run->stages[stage - 1][j] : x[j];
        set_signals(run, i, ((double)n + at) / (double)substeps);
        slopes(run, trial, run->stages[stage]);
    }
    double *const *k = run->stages;
    for (size_t j = 0; j < count; j++)
        x[j] += h / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
}

void advance_output_states(OutputRun *run, size_t i) {
    const Record *a = run->record;
    if (a->decay > 0.0) {
        follow(run, i);
        return;
    }
    const int64_t substeps = substep_count(a->times[i + 1] - a->times[i], a->rate);
    for (int64_t n = 0; n < substeps; n++) substep(run, i, n, substeps);
}

/* Inputs and outputs as they were recorded at grid time i, and the time. */
static void set_recorded(OutputRun *run, size_t i) {
    const Record *a = run->record;
    double *u = run->r + run->p->first_input, *y = u + a->n_inputs;
    FOR(j, a->n_inputs) u[j] = a->values[i * a->n_inputs + j];
    FOR(j, a->n_outputs) y[j] = a->outputs[i * a->n_outputs + j];
    run->r[0] = a->times[i];
}

/* The output at grid time i is changed only when nothing before asks for it any more. */
static void apply(OutputRun *run) {
    const Record *a = run->record;
    const Program *p = run->p;
    double before = 0.0;
    for (size_t i = 0; i < a->n_times; i++) {
        if (i > 0 && p->n_own > 0) advance_output_states(run, i - 1);
        set_recorded(run, i);
        memcpy(run->r + 1, run->x, p->n_own * sizeof *run->x);
        if (i == 0) {
            run_fast(p->fast[START], run->r);
            memcpy(run->x, run->r + 1, p->n_own * sizeof *run->x);
        }
        run_fast(p->fast[BEFORE], run->r);
        if (i > 0) a->outputs[(i - 1) * a->n_outputs + a->column] = before;
        before = run->r[p->first_parameter];
    }
    a->outputs[(a->n_times - 1) * a->n_outputs + a->column] = before;
}

int core_apply_to_outputs(const Record *a) {
    const Program *p = a->program;
    if (p->n_states != p->n_own || p->n_inputs != a->n_inputs + a->n_outputs
        || p->n_parameters != 1 || p->n_base != 0 || a->n_times == 0 || a->column >= a->n_outputs
        || (a->decay > 0.0 && p->n_own != 1))
        return WRONG_SIZES;
    const size_t own = p->n_own;
    double *m = calloc(p->n_registers + 5 * own, sizeof *m);
    if (m == NULL) return NO_MEMORY;
    OutputRun run = {a, p, m, m + p->n_registers, {0}};
    for (size_t stage = 0; stage < 4; stage++) run.stages[stage] = run.x + (1 + stage) * own;
    memcpy(m + p->first_constant, p->constants, p->n_constants * sizeof *m);
    memcpy(m + p->first_coefficient, a->coefficients, p->n_coefficients * sizeof *m);
    run_fast(p->fast[ONCE], m);
    apply(&run);
    free(m);
    return FINISHED;
}
