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
enum { MOST_STATES = 4, MOST_INPUTS = 1 }; /* of a shape */

/* Where a simulation's numbers are. A loop of a shape has them in arrays of its own. */
typedef struct {
    double *r;                   /* registers of effects; the next five lie in them: */
    double *time, *trial, *u;    /* where the FMU is: time, states, inputs as measured */
    double *effective, *varied;  /* inputs and parameters as the FMU sees them */
    double *x, *k;               /* (x) accepted states; (7, x) derivatives of stages */
} Places;

/* The FMU, the experiment and the effects of a batch. */
typedef struct {
    Fmu f;
    Places at;
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
    double *r, *time, *trial, *u, *effective, *varied, *x, *k; /* the same as in `model.at` */
    double *atols, *end;                /* (x), (x) tolerances at present; memory */
    double *input_slopes;               /* (u) */
    double *seen;                       /* (u) what the FMU computes and effects read */
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
/* In co-simulation: read what the FMU computes and effects depend on, where it stands; and put that
 * into the registers of the inputs, where it stays until it is read again. */
int see_outputs(Work *w);
void hold_seen(Work *w);
/* Reset, write every start value, initialise. Returns the status. */
int initialise(Work *w, const double *point, double tolerance);
/* Add the squares of the residuals at grid time i; whether the sum is above its bound. */
int is_above_bound(Work *w, size_t i, const double *y);
/* Equal steps of an interval, none longer than `longest`; more than `limit` is `limit` + 1. */
int64_t n_steps(double length, double longest, int64_t limit);
/* Classic Runge-Kutta steps for a rate, where nothing else controls the error. */
int64_t substep_count(double length, double rate);
/* Steps that may be taken to the next time of the grid after `taken` steps. */
static inline int64_t steps_granted(const Settings *s, int64_t taken) {
    const int64_t rest = s->all_steps - taken;
    return s->all_steps > 0 && rest < s->max_steps ? rest : s->max_steps;
}
/* The code of a part of a simulation after `taken` steps: which of the two limits ended it. */
static inline int limit_reached(const Settings *s, int64_t taken, int code) {
    return code == TOO_MANY_STEPS && s->all_steps > 0 && taken >= s->all_steps ? OUT_OF_STEPS : code;
}
/* Say in a batch how the simulation of point p ended; returns the code. */
int put_end(const Batch *batch, size_t p, End end);

/* The simulation of one point, by method. LOOP makes one for a shape: version, effects, reals,
 * states, inputs; there is one for each shape that is common. */
typedef End Loop(Work *w, const double *point, double *outputs);
typedef Loop *LoopFor(const Model *c);
#define LOOP(simulate, name, ...)                               \
    static End name(Work *w, const double *point, double *y) {  \
        return simulate(w, point, y, (Shape){__VA_ARGS__});     \
    }
LoopFor co_simulation_loop, runge_kutta_loop, dormand_prince_loop;
Loop cvode_loop;

static inline int failed(int code, int status) { return status >= FATAL ? code + IS_FATAL : code; }
static inline double smaller(double a, double b) { return b < a ? b : a; }
static inline double larger(double a, double b) { return b > a ? b : a; }

/* The inputs between two times of the grid. Those of a shape are in arrays of its own. */
typedef struct {
    double begin, own[2][MOST_INPUTS];
    const double *values, *slopes;
} Interval;

ALWAYS Interval interval(const Model *c, const Shape s, size_t i) {
    Interval a = {.begin = c->times[i], .values = c->values + i * N_INPUTS,
                  .slopes = c->slopes + i * N_INPUTS};
    for (int j = 0; j < s.n_inputs; j++) a.own[0][j] = a.values[j], a.own[1][j] = a.slopes[j];
    return a;
}

/* The measured inputs at `offset` after the begin of an interval, into the registers. */
ALWAYS void interpolate(const Model *c, const Shape s, const Interval *a, double offset) {
    if (s.n_inputs >= 0)
        for (int j = 0; j < s.n_inputs; j++) c->at.u[j] = a->own[0][j] + offset * a->own[1][j];
    else
        FOR(j, c->n_inputs) c->at.u[j] = a->values[j] + offset * a->slopes[j];
}

/* The same into the registers of `w`, for what happens rarely. */
void interpolate_at(Work *w, size_t i, double time);

/* A loop's own arrays, of a shape without effects; with effects states and inputs are registers. */
typedef struct {
    double x[MOST_STATES], trial[MOST_STATES], u[MOST_INPUTS], k[7 * MOST_STATES];
} Own;

ALWAYS Model with_own(const Model *model, const Shape s, Own *own) {
    Model copy = *model;
    if (s.n_states < 0 || s.n_inputs < 0) return copy;
    copy.at.x = own->x, copy.at.k = own->k;
    if (s.effects == 0) copy.at.trial = own->trial, copy.at.u = copy.at.effective = own->u;
    return copy;
}

/* Accepted states from a loop's own array to where others find them, and back. */
ALWAYS void hand_over(const Model *c, const Shape s, Work *w) {
    if (s.n_states >= 0) memcpy(w->x, c->at.x, (size_t)s.n_states * sizeof *w->x);
}
ALWAYS void take_back(const Model *c, const Shape s, Work *w) {
    if (s.n_states >= 0) memcpy(c->at.x, w->x, (size_t)s.n_states * sizeof *w->x);
}

ALWAYS int set_inputs(const Model *c, const Shape s, Work *w, const double *row) {
    if (!s.reals) return set_values(&w->model.f, FMI, &w->model.inputs, row, w->buffer);
    return N_INPUTS > 0 ? set_reals(&c->f, FMI, c->inputs.reals, N_INPUTS, row) : OK;
}

ALWAYS int get_outputs(const Model *c, const Shape s, Work *w, double *row) {
    if (!s.reals) return get_values(&w->model.f, FMI, &w->model.outputs, row, w->buffer);
    return get_reals(&c->f, FMI, c->outputs.reals, c->outputs.n_reals, row);
}

/* In co-simulation, one step of the FMU from grid time i to the next. */
ALWAYS int one_step(const Model *c, const Shape s, Work *w, size_t i) {
    if (c->f.interpolates_inputs && c->continuous.n_reals > 0)
        TRY(set_input_slopes(&c->f, c->inputs.reals, c->inputs.n_reals, w->orders,
                             c->slopes + i * N_INPUTS));
    c->progress[CALLED] = 1;
    return do_step(&c->f, FMI, c->times[i], c->intervals[i], &w->info);
}

/* Whether a batch has the shape of float64 scalars alone. */
static inline int has_reals(const Model *c) {
    return c->inputs.n_elements == 0 && c->continuous.n_elements == 0
           && c->outputs.n_elements == 0 && c->outputs.n_reals > 0
           && c->inputs.n_reals == c->n_inputs && c->continuous.n_reals == c->n_inputs;
}

/* ---- step by step, for the wrapper of exported FMUs ---------------------------------------- */

/* In co-simulation: set inputs and parameters, as effects make them, at a time of an interval; and
 * step from grid time i, where that was done, to the next. Returns the status. */
int set_effective(Work *w, const Interval *a, double time);
int several_steps(Work *w, size_t i, int64_t steps);

/* An effect at an output under way: registers; own states, and their derivatives; matrices of a
 * step where several follow linearly. */
typedef struct {
    const Record *record;
    const Program *p;
    double *r, *x, *stages[4], *matrices[5], length;
} OutputRun;

/* Own states from grid time i to the next. */
void advance_output_states(OutputRun *run, size_t i);

#endif
