/* An extended Kalman filter along one simulation of a model.
 *
 * Between two times of the grid the states follow the model, and their covariance its linearisation
 * at the filtered states:
 *
 *     dP/dt = A P + P A' + Q,    Q = diag(q^2).
 *
 * At a measured time each output updates both, one after the other, as their noises are
 * independent: with the innovation e = y - g(x) - C (x' - x), x' having the updates before it,
 *
 *     S = C P C' + R,    K = P C' / S,    x' += K e,    P -= K S K'.
 *
 * References: A. H. Jazwinski, Stochastic Processes and Filtering Theory (1970), section 8.3; G. J.
 * Bierman, Factorization Methods for Discrete Sequential Estimation (1977), for the order of
 * updates; C. F. Van Loan, IEEE Trans. Autom. Control 23 (1978) 395-404,
 * doi:10.1109/TAC.1978.1101743, for the integral by doubling.
 */
#include <stdlib.h>

#include "linearise.h"

static const double short_norm = 0.1; /* of A h, up to which series are taken */
enum { TERMS = 7, MOST_DOUBLINGS = 60 };

typedef struct {
    const Kalman *k;
    size_t n;
    double *P, *F, *G, *product, *other; /* covariance, transition, integral of F Q F' and memory */
    double *change, *gain;               /* what updates add to the states, and K S */
} Filter;

/* ---- matrices (n, n) --------------------------------------------------------------------- */

static void multiply(size_t n, const double *one, const double *two, double *result) {
    for (size_t r = 0; r < n; r++)
        for (size_t k = 0; k < n; k++) {
            double total = 0.0;
            for (size_t m = 0; m < n; m++) total += one[r * n + m] * two[m * n + k];
            result[r * n + k] = total;
        }
}

static void add(size_t n, const double *one, double *result) {
    for (size_t j = 0; j < n * n; j++) result[j] += one[j];
}

static void fill_diagonal(size_t n, double *matrix, const double *values, double factor,
                          double constant) {
    for (size_t r = 0; r < n; r++)
        for (size_t k = 0; k < n; k++)
            matrix[r * n + k] = r == k ? factor * values[r] + constant : 0.0;
}

/* result = factor M + transposed M'. */
static void scale(size_t n, const double *one, double *result, double factor, double transposed) {
    for (size_t r = 0; r < n; r++)
        for (size_t k = 0; k < n; k++)
            result[r * n + k] = factor * one[r * n + k] + transposed * one[k * n + r];
}

/* The largest sum of magnitudes in a row. */
static double norm(size_t n, const double *matrix) {
    double largest = 0.0;
    for (size_t r = 0; r < n; r++) {
        double total = 0.0;
        for (size_t k = 0; k < n; k++) total += fabs(matrix[r * n + k]);
        largest = larger(largest, total);
    }
    return largest;
}

/* other = F M F'. */
static void congruence(Filter *f, const double *matrix) {
    const size_t n = f->n;
    multiply(n, f->F, matrix, f->product);
    for (size_t r = 0; r < n; r++)
        for (size_t k = 0; k < n; k++) {
            double total = 0.0;
            for (size_t m = 0; m < n; m++) total += f->product[r * n + m] * f->F[k * n + m];
            f->other[r * n + k] = total;
        }
}

/* ---- prediction -------------------------------------------------------------------------- */

/* The series of F = exp(A h), and of the integral of F Q F'. */
static void short_step(Filter *f, const double *A, double h) {
    const size_t n = f->n;
    const double *q2 = f->k->diffusion;
    fill_diagonal(n, f->product, q2, 0.0, 1.0);
    fill_diagonal(n, f->F, q2, 0.0, 1.0);
    for (int order = 1; order < TERMS; order++) { /* (A h)^i / i! */
        multiply(n, f->product, A, f->other);
        scale(n, f->other, f->product, h / order, 0.0);
        add(n, f->product, f->F);
    }
    fill_diagonal(n, f->product, q2, h, 0.0);
    fill_diagonal(n, f->G, q2, h, 0.0);
    for (int order = 1; order < TERMS; order++) { /* h^(i + 1) / (i + 1)! of A M + M A' */
        multiply(n, A, f->product, f->other);
        scale(n, f->other, f->product, h / (order + 1), h / (order + 1));
        add(n, f->product, f->G);
    }
}

/* Carry the covariance over a step: P = F P F' + the integral of F Q F'. */
static void predict(Filter *f, const double *A, double seconds) {
    const size_t n = f->n;
    const double size = norm(n, A);
    double h = seconds;
    int doublings = 0;
    for (; size * h > short_norm && doublings < MOST_DOUBLINGS; doublings++) h *= 0.5;
    short_step(f, A, h);
    for (; doublings > 0; doublings--) { /* G(2h) = G(h) + F(h) G(h) F(h)', F(2h) = F(h) F(h) */
        congruence(f, f->G);
        add(n, f->other, f->G);
        multiply(n, f->F, f->F, f->other);
        memcpy(f->F, f->other, n * n * sizeof *f->F);
    }
    congruence(f, f->P);
    for (size_t r = 0; r < n; r++)
        for (size_t k = 0; k < n; k++)
            f->P[r * n + k] = 0.5 * (f->other[r * n + k] + f->other[k * n + r]) + f->G[r * n + k];
}

/* ---- correction -------------------------------------------------------------------------- */

/* By one output, at place `at` of the measurements, whose derivatives by the states are C. */
static void correct(Filter *f, size_t at, double e, const double *C) {
    const size_t n = f->n;
    double S = f->k->variances[at];
    for (size_t r = 0; r < n; r++) {
        e -= C[r] * f->change[r];
        f->gain[r] = 0.0;
        for (size_t k = 0; k < n; k++) f->gain[r] += f->P[r * n + k] * C[k];
    }
    for (size_t r = 0; r < n; r++) S += C[r] * f->gain[r];
    f->k->innovations[at] = e;
    f->k->spreads[at] = S;
    for (size_t r = 0; r < n; r++) {
        f->change[r] += f->gain[r] / S * e;
        for (size_t k = 0; k < n; k++) f->P[r * n + k] -= f->gain[r] * f->gain[k] / S;
    }
}

/* Correct states and covariance by what was measured at grid time i; whether anything was. */
static int update(Filter *f, size_t i, const double *predicted, size_t n_outputs, double *x,
                  const double *C) {
    int measured = 0;
    memset(f->change, 0, f->n * sizeof *f->change);
    for (size_t j = 0; j < n_outputs; j++) {
        const double y = f->k->measured[i * n_outputs + j];
        if (isnan(y)) continue;
        measured = 1;
        correct(f, i * n_outputs + j, y - predicted[j], C + j * f->n);
    }
    for (size_t r = 0; r < f->n; r++) x[r] += f->change[r];
    return measured;
}

/* Correct at grid time i, linearise where the filtered states are, and predict the covariance at the
 * next time. */
static int filter_at(Differences *d, size_t i, double time, const double *y, void *how) {
    Filter *f = how;
    Work *w = d->w;
    const Model *c = &w->model;
    const size_t n = f->n, m = c->n_outputs;
    TRY(linearise_at(d, i));
    if (update(f, i, y, m, w->x, d->l->C + i * m * n)) {
        memcpy(w->trial, w->x, n * sizeof *w->x);
        TRY(set_model(c, ANY, w, time));
        TRY(linearise_at(d, i));
    }
    if (i + 1 < c->n_times) predict(f, d->l->A + i * n * n, c->times[i + 1] - c->times[i]);
    return OK;
}

static int begin_filter(Filter *f, const Kalman *k, size_t n) {
    double *m = malloc((4 * n * n + 2 * n + 1) * sizeof *m);
    if (m == NULL) return NO_MEMORY;
    *f = (Filter){.k = k, .n = n, .P = k->covariance, .F = m, .G = m + n * n,
                  .product = m + 2 * n * n, .other = m + 3 * n * n, .change = m + 4 * n * n,
                  .gain = m + 4 * n * n + n};
    return FINISHED;
}

int core_filter(const Batch *batch, const Linearisation *l, const Kalman *kalman) {
    Paired p;
    Filter f = {0};
    int code = begin_pair(&p, batch, l);
    if (code == FINISHED) code = begin_filter(&f, kalman, batch->n_states);
    const End end =
        code == FINISHED ? along_grid(&p.d, filter_at, &f) : (End){code, 0.0, 0};
    free(f.F);
    return end_pair(&p, end);
}
