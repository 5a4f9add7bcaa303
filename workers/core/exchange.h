/* Model exchange: time, states and inputs of an FMU, its derivatives and outputs; events. */
#ifndef EXCHANGE_H
#define EXCHANGE_H
#include "work.h"

/* Set the FMU to time, states and inputs of the registers, with their effects. */
ALWAYS int set_model(const Model *c, const Shape s, Work *w, double time) {
    const double *u = c->at.u;
    c->progress[CALLED] = 1;
    TRY(set_time(&c->f, time));
    if (FMU_STATES > 0) TRY(set_continuous_states(&c->f, c->at.trial, FMU_STATES));
    if (EFFECTS) {
        *c->at.time = time;
        if (c->changes_inputs) {
            run_fast(c->program->fast[BEFORE], c->at.r);
            u = c->at.effective;
        }
    }
    if (s.reals) {
        if (N_INPUTS > 0) TRY(set_reals(&c->f, FMI, c->inputs.reals, N_INPUTS, u));
    } else {
        TRY(set_values(&w->model.f, FMI, &w->model.continuous, u, w->buffer));
    }
    if (EFFECTS && c->n_parameters > 0)
        TRY(set_reals(&c->f, FMI, c->parameters, c->n_parameters, c->at.varied));
    return OK;
}

/* dx/dt where the FMU and the registers are. */
ALWAYS int derivatives(const Model *c, const Shape s, double *dx) {
    if (FMU_STATES > 0) TRY(get_vector(c->f.get_derivatives, c->f.handle, dx, FMU_STATES));
    if (EFFECTS) {
        const Program *p = c->program;
        const Site *sites = p->sites;
        const double *r = c->at.r;
        run_fast(p->fast[AFTER], c->at.r);
        FOR(j, p->n_added) dx[sites[j].state] += r[sites[j].r];
        for (size_t j = p->n_added; j < p->n_sites; j++) dx[sites[j].state] = r[sites[j].r];
    }
    return OK;
}

/* dx/dt at the states in `trial`, at a time in an interval of the grid. */
ALWAYS int derivatives_at(const Model *c, const Shape s, Work *w, const Interval *a, double time,
                          double *dx) {
    interpolate(c, s, a, time - a->begin);
    TRY(set_model(c, s, w, time));
    return derivatives(c, s, dx);
}

/* Set the FMU to x, with the inputs at `offset` after the begin of an interval. */
ALWAYS int set_to_x(const Model *c, const Shape s, Work *w, const Interval *a, double offset,
                    double time) {
    if (s.n_states >= 0)
        memcpy(c->at.trial, c->at.x, (size_t)s.n_states * sizeof *c->at.x);
    else
        FOR(j, c->n_states) c->at.trial[j] = c->at.x[j];
    interpolate(c, s, a, offset);
    return set_model(c, s, w, time);
}

/* Set the FMU to the begin of an interval and record its outputs; `time` may be later by a rounding
 * error, where an event is. */
ALWAYS int record(const Model *c, const Shape s, Work *w, const Interval *a, double time,
                  double *y) {
    TRY(set_to_x(c, s, w, a, 0.0, time));
    return get_outputs(c, s, w, y);
}

/* trial = x + h k. Few states go through an array of their own, whose 16-byte stores the FMU's
 * 16-byte loads wait for less than for two stores of 8 bytes (store forwarding). */
ALWAYS void move_states(const Model *c, const Shape s, double h, const double *k) {
    double *restrict const trial = c->at.trial;
    const double *restrict const x = c->at.x;
    if (s.n_states >= 0) {
        double next[MOST_STATES];
        for (int j = 0; j < s.n_states; j++) next[j] = x[j] + h * k[j];
        memcpy(trial, next, (size_t)s.n_states * sizeof *trial);
    } else {
        FOR(j, c->n_states) trial[j] = x[j] + h * k[j];
    }
}

/* The length of time below which two times are the same. */
static inline double time_resolution(double time, double last) {
    return 16.0 * 0x1p-52 * larger(fabs(time), fabs(last));
}

/* Whether steps that know nothing of events will do, until when there is no time event. */
static inline int is_quiet(const Model *c) {
    return c->f.n_indicators == 0 && !c->f.completes_steps && !c->f.eventful;
}
static inline double quiet_until(const Work *w) {
    const Model *c = &w->model;
    return w->next_event - time_resolution(c->times[0], c->times[c->n_times - 1]);
}

/* ---- exchange.c: rare, or once a simulation ---------------------------------------------- */

/* Set the FMU to states at a time in the interval after grid time i. */
int set_at(Work *w, size_t i, double time, const double *x);
/* Initialise, iterate the initial event to its end, and fetch the states. Returns the code. */
int start_simulation(Work *w, const double *point);
/* Tell the FMU that a step is accepted. FINISHED, EVENT, or why it must end. */
int complete_step(Work *w);
/* Handle inputs that jump at grid time i, which is an event for some FMUs. */
int handle_input_jump(Work *w, size_t i, double time);

/* The same from a loop of a shape. */
ALWAYS int jump(const Model *c, const Shape s, Work *w, size_t i, double time) {
    hand_over(c, s, w);
    const int code = handle_input_jump(w, i, time);
    take_back(c, s, w);
    return code;
}

/* ---- events.c ---------------------------------------------------------------------------- */

/* Handle an event: inputs are those after grid time `before` until it, those after i from then on;
 * `repeated` counts the events before this one between which no time has passed. */
int handle_event(Work *w, size_t before, size_t i, double time, int64_t repeated);
/* In event mode, let the FMU update its discrete states to the end, and leave the mode. */
int iterate_event(Work *w, int *status);
int store_event_indicators(Work *w);
/* States at a part of a step, into `trial`. */
typedef void Interpolant(Work *w, double time, double h, double part, const void *how);
/* Look for a state event in a step that ends at `trial`, which the FMU is set to. *part: which part
 * of the step is left of it, at most 1; 2 without one. Behind one, `trial` and the FMU are
 * there. */
int find_event(Work *w, size_t i, double time, double h, Interpolant *interpolant, const void *how,
               double *part);
/* Of a Runge-Kutta method: each stage's weight as a polynomial, from the first power on. */
typedef struct {
    size_t n_stages, n_powers;
    const double *weights;
} DenseOutput;
Interpolant dense_output;

/* ---- stepping from grid time i to the next, from event to event -------------------------- */

typedef struct Forward Forward; /* of forward sensitivities, see sensitivities.c */

/* Where a solver is: the time, the step to try next (0: none yet), and the steps that are left. */
typedef struct {
    double time, proposed;
    int64_t left;
} Stepping;

int equal_steps(Work *w, size_t i, Stepping *now, Forward *forward);
int adaptive_steps(Work *w, size_t i, Stepping *now, Forward *forward);
int advance_sensitivities(Work *w, size_t i, double time, double h, Forward *forward);
/* The next stop on the way to grid time i + 1: that time, or a time event. */
double next_stop(const Work *w, double last, double resolution);

#endif
