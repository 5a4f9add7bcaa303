/* Effects at outputs: applied to recorded outputs after a simulation.
 *
 * An own state that follows signals linearly, x' = g(t) - a x with g linear between two times of
 * the grid, is advanced exactly, in one step, by an exponential integrator (M. Hochbruck, A.
 * Ostermann, Acta Numerica 19 (2010) 209-286, doi:10.1017/S0962492910000048), and so are several
 * that follow together, however fast one of them is. Others are advanced by Runge-Kutta substeps,
 * eight for each time constant.
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

/* out = a b + I / divisor */
static void multiply(size_t n, const double *a, const double *b, double divisor, double *out) {
    FOR(i, n) FOR(j, n) {
        double total = i == j && divisor > 0.0 ? 1.0 / divisor : 0.0;
        FOR(k, n) total += a[i * n + k] * b[k * n + j];
        out[i * n + j] = total;
    }
}

static void swap(double **a, double **b) {
    double *const kept = *a;
    *a = *b;
    *b = kept;
}

enum { TERMS = 12 }; /* at a norm of 1/2 the first that is left out is below rounding */

/* phi_1 and phi_2 of length times the matrix, by scaling and squaring (B. Skaflestad, W. M. Wright,
 * Appl. Numer. Math. 59 (2009) 783-799, doi:10.1016/j.apnum.2008.03.035), if the length is another
 * by more than rounding. */
static void make_matrices(OutputRun *run, double length) {
    const size_t n = run->p->n_own, entries = n * n;
    double *z = run->matrices[0], *phi_0 = run->matrices[3], *free = run->matrices[4];
    double **const phi_1 = run->matrices + 1, **const phi_2 = run->matrices + 2;
    if (fabs(length - run->length) <= 1e-9 * run->length) return;
    run->length = length;
    double size = 0.0, factorial = 1.0;
    FOR(i, n) {
        double row = 0.0;
        FOR(j, n) row += fabs(z[i * n + j] = length * run->record->linear[i * n + j]);
        size = larger(size, row);
    }
    int halvings = 0;
    for (; size > 0.5 && halvings < 1000; size *= 0.5) halvings++;
    FOR(j, entries) z[j] = ldexp(z[j], -halvings);
    for (int k = 2; k <= TERMS + 2; k++) factorial *= k;
    memset(*phi_2, 0, entries * sizeof **phi_2);
    for (int k = TERMS + 2; k >= 2; factorial /= k--) {
        multiply(n, z, *phi_2, factorial, free);
        swap(phi_2, &free);
    }
    multiply(n, z, *phi_2, 1.0, *phi_1);
    multiply(n, z, *phi_1, 1.0, phi_0);
    for (; halvings > 0; halvings--) {
        multiply(n, phi_0, *phi_2, 0.0, free);
        FOR(j, entries) free[j] = 0.25 * (free[j] + (*phi_1)[j] + (*phi_2)[j]);
        swap(phi_2, &free);
        multiply(n, phi_0, *phi_1, 0.0, free);
        FOR(j, entries) free[j] = 0.5 * (free[j] + (*phi_1)[j]);
        swap(phi_1, &free);
        multiply(n, phi_0, phi_0, 0.0, free);
        swap(&phi_0, &free);
    }
    run->matrices[3] = phi_0, run->matrices[4] = free;
}

/* Over the interval after grid time i, where several own states follow linearly. */
static void follow_together(OutputRun *run, size_t i) {
    const Record *a = run->record;
    const size_t n = run->p->n_own;
    const double length = a->times[i + 1] - a->times[i];
    double *first = run->stages[0], *last = run->stages[1], *moved = run->stages[2];
    set_signals(run, i, 0.0);
    slopes(run, run->x, first);
    set_signals(run, i, 1.0);
    run->r[0] = a->times[i + 1];
    slopes(run, run->x, last);
    make_matrices(run, length);
    FOR(j, n) {
        moved[j] = 0.0;
        FOR(k, n)
            moved[j] += run->matrices[1][j * n + k] * first[k]
                        + run->matrices[2][j * n + k] * (last[k] - first[k]);
    }
    FOR(j, n) run->x[j] += length * moved[j];
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
    if (a->linear != NULL) {
        follow_together(run, i);
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
        if (i % a->every > 0) continue;
        set_recorded(run, i);
        memcpy(run->r + 1, run->x, p->n_own * sizeof *run->x);
        if (i == 0) {
            run_fast(p->fast[START], run->r);
            memcpy(run->x, run->r + 1, p->n_own * sizeof *run->x);
        }
        run_fast(p->fast[BEFORE], run->r);
        if (i > 0) a->outputs[(i - a->every) * a->n_outputs + a->column] = before;
        before = run->r[p->first_parameter];
    }
    a->outputs[(a->n_times - 1) * a->n_outputs + a->column] = before;
}

int core_apply_to_outputs(const Record *a) {
    const Program *p = a->program;
    if (p->n_states != p->n_own || p->n_inputs != a->n_inputs + a->n_outputs
        || p->n_parameters != 1 || p->n_base != 0 || a->n_times == 0 || a->column >= a->n_outputs
        || a->every == 0 || (a->n_times - 1) % a->every > 0
        || (a->decay > 0.0 && p->n_own != 1))
        return WRONG_SIZES;
    const size_t own = p->n_own;
    double *m = calloc(p->n_registers + 5 * own + 5 * own * own, sizeof *m);
    if (m == NULL) return NO_MEMORY;
    OutputRun run = {.record = a, .p = p, .r = m, .x = m + p->n_registers};
    for (size_t stage = 0; stage < 4; stage++) run.stages[stage] = run.x + (1 + stage) * own;
    FOR(k, 5) run.matrices[k] = run.x + 5 * own + k * own * own;
    memcpy(m + p->first_constant, p->constants, p->n_constants * sizeof *m);
    memcpy(m + p->first_coefficient, a->coefficients, p->n_coefficients * sizeof *m);
    run_fast(p->fast[ONCE], m);
    apply(&run);
    free(m);
    return FINISHED;
}

enum { STENCIL = 4 };

/* The outputs at a time of interval i: by the cubic through four records, or the line. */
static void between(const Pieces *a, size_t i, double at, double share, double *result) {
    const size_t n = a->n_outputs;
    const double *y = a->outputs + i * n;
    if (!a->smooth[i]) {
        FOR(c, n) result[c] = y[c] + share * (y[n + c] - y[c]);
        return;
    }
    const double *knots = a->times + a->first[i];
    double weight[STENCIL];
    FOR(j, STENCIL) {
        weight[j] = 1.0;
        FOR(m, STENCIL) if (m != j) weight[j] *= (at - knots[m]) / (knots[j] - knots[m]);
    }
    y = a->outputs + (size_t)a->first[i] * n;
    FOR(c, n)
        result[c] = (weight[0] * y[c] + weight[2] * y[2 * n + c])
                    + (weight[1] * y[n + c] + weight[3] * y[3 * n + c]);
}

void core_refine(const Pieces *a) {
    const size_t last = a->n_times - 1, u = a->n_inputs, n = a->n_outputs;
    for (size_t i = 0, row = 0; i <= last; i++) {
        const double *value = a->values + i * u, *slope = a->slopes + i * u;
        for (size_t p = 0; p < (i < last ? a->pieces : 1); p++, row++) {
            const double share = (double)p / (double)a->pieces, passed = share * a->lengths[i];
            a->at[row] = a->times[i] + passed;
            FOR(j, u) a->fine_values[row * u + j] = value[j] + passed * slope[j];
            memcpy(a->fine_slopes + row * u, slope, u * sizeof *slope);
            if (p > 0)
                between(a, i, a->at[row], share, a->fine_outputs + row * n);
            else
                memcpy(a->fine_outputs + row * n, a->outputs + i * n, n * sizeof(double));
        }
    }
}
