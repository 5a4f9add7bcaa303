/* What all methods share: the model as a loop sees it, its memory, and the inputs of a time.
 *
 * How loops are as fast as loops by hand: a `Shape` is a constant wherever these functions are
 * inlined, so that a loop is compiled for each shape that is common, from one source. A loop copies
 * the `Model` to its stack, where the FMU cannot change it, as far as a compiler knows.
 */
#ifndef WORK_H
#define WORK_H
#include <string.h>

#include "program.h"
#include "values.h"

typedef struct {
    int fmi;      /* version; 0: not known before */
    int effects;  /* whether there are any; -1: not known before */
    int reals;    /* whether inputs and outputs are float64 scalars alone, and there are outputs */
    int n_states; /* -1: not known before */
    int n_inputs; /* -1: not known before */
} Shape;

#define ANY ((Shape){0, -1, 0, -1, -1})
enum { MOST_STATES = 4 }; /* of a shape */

/* The FMU, the experiment and the effects of a batch. */
typedef struct {
    Fmu f;
    Variables inputs, continuous, outputs;
    const double *times, *intervals, *values, *slopes;
    size_t n_times, n_inputs, n_outputs, n_states;
    const Program *program;
    const uint32_t *parameters; /* that effects change */
    size_t n_parameters;
    int64_t *progress;
    int changes_inputs; /* effects do, or parameters */
} Model;

/* Memory of one simulation after the other. */
typedef struct {
    double *r;                          /* registers of effects; the next five lie in them: */
    double *time, *trial, *u;           /* where the FMU is: time, states, inputs as measured */
    double *effective, *parameters;     /* inputs and parameters as the FMU sees them */
    double *x, *k;                      /* (x) accepted states; (7, x) derivatives of stages */
    double *atols, *end;                /* (x), (x) tolerances at present; memory */
    double *input_slopes;               /* (u) */
    double *indicators[3];              /* after the last step, behind an event, of a trial */
    double *buffer;                     /* of one variable */
    int32_t *orders;                    /* as many ones as inputs */
    double next_event, fastest_rate;
    double sum, bound;                  /* of squared residuals */
    EventInfo info;
    const Batch *batch;
    Model model;
    void *memory;
} Work;

/* How a simulation ended: a code, and the time and the grid's index where it was. */
typedef struct {
    int code;
    double time;
    size_t index;
} End;

enum { CALLED, SIMULATIONS, RUNNING, STEPS }; /* places in `progress` */

#define FMI (s.fmi ? s.fmi : c->f.version)
#define EFFECTS (s.effects >= 0 ? s.effects : c->program != NULL)
#define N_STATES (s.n_states >= 0 ? (size_t)s.n_states : c->n_states)
#define FMU_STATES (s.n_states >= 0 ? (size_t)s.n_states : c->f.n_states)
#define N_INPUTS (s.n_inputs >= 0 ? (size_t)s.n_inputs : c->n_inputs)
/* Short loops: vectorising those whose length is not known costs more than it brings. */
#ifdef __clang__
#define FOR(j, n) _Pragma("clang loop vectorize(disable)") for (size_t j = 0; j < (n); j++)
#else
#define FOR(j, n) for (size_t j = 0; j < (n); j++)
#endif

/* NO_MEMORY or WRONG_SIZES where there is nothing to work with. */
int begin_work(Work *w, const Batch *batch);
void end_work(Work *w);
/* Begin the simulation of point p: its coefficients, base values and bound. */
void select_point(Work *w, size_t p);
/* What depends on coefficients alone, after one of them was changed. */
void update_coefficients(Work *w);
/* Inputs that the FMU is initialised with; its states are not known yet and count as 0. */
void initial_inputs(Work *w);
/* The own states of effects at the start, into x, where the FMU's are. */
void start_own_states(Work *w);
/* Reset, write every start value, initialise. Returns the status. */
int initialise(Work *w, const double *point, double tolerance);
/* Add the squares of the residuals at grid time i; whether the sum is above its bound. */
int is_above_bound(Work *w, size_t i, const double *y);
/* Equal steps of an interval, none longer than `longest`; more than `limit` is `limit` + 1. */
int64_t n_steps(double length, double longest, int64_t limit);
/* Classic Runge-Kutta steps for a rate, where nothing else controls the error. */
int64_t substep_count(double length, double rate);
/* Run a loop for all points of a batch, up to the first that fails. */
typedef End Loop(Work *w, const double *point, double *outputs);
size_t for_all_points(const Batch *batch, Loop *(*choose)(const Model *));
/* By method. */
size_t core_co_simulate(const Batch *batch);
size_t core_runge_kutta(const Batch *batch);
size_t core_dormand_prince(const Batch *batch);
size_t core_cvode(const Batch *batch);

static inline int failed(int code, int status) { return status >= FATAL ? code + IS_FATAL : code; }
static inline double smaller(double a, double b) { return b < a ? b : a; }
static inline double larger(double a, double b) { return b > a ? b : a; }

/* The measured inputs at `offset` after grid time i, into the registers. */
ALWAYS void interpolate(const Model *c, const Shape s, Work *w, size_t i, double offset) {
    const double *values = c->values + i * N_INPUTS, *slopes = c->slopes + i * N_INPUTS;
    FOR(j, N_INPUTS) w->u[j] = values[j] + offset * slopes[j];
}

ALWAYS int set_inputs(const Model *c, const Shape s, Work *w, const double *row) {
    if (!s.reals) return set_values(&w->model.f, FMI, &w->model.inputs, row, w->buffer);
    return N_INPUTS > 0 ? set_reals(&c->f, FMI, c->inputs.reals, N_INPUTS, row) : OK;
}

ALWAYS int get_outputs(const Model *c, const Shape s, Work *w, double *row) {
    if (!s.reals) return get_values(&w->model.f, FMI, &w->model.outputs, row, w->buffer);
    return get_reals(&c->f, FMI, c->outputs.reals, c->outputs.n_reals, row);
}

/* Whether a batch has the shape of float64 scalars alone. */
static inline int has_reals(const Model *c) {
    return c->inputs.n_elements == 0 && c->continuous.n_elements == 0
           && c->outputs.n_elements == 0 && c->outputs.n_reals > 0
           && c->inputs.n_reals == c->n_inputs && c->continuous.n_reals == c->n_inputs;
}

#endif
