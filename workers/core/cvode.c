/* CVODE: backward differences of order 1 to 5, for stiff models; its functions are called by
 * address.
 *
 * How it treats inputs was measured on a stiff reaction with 1000 samples of its feed:
 *
 * - Where a held input jumps, it starts again. To leave it to the error control takes twice as long
 *   on noise and makes five to fourteen times the error.
 * - At a kink of an input, it stops, but keeps its history: to start again would cost three to six
 *   times as much on a smooth input. Not to stop at all would be two to three times as fast there,
 *   but a long step might pass over a pulse, and nobody would know.
 * - At other times of the grid, it does not stop; the states there are those of the polynomial that
 *   it steps with. An FMU is told that a step is accepted only after it was asked for its outputs
 *   at the times within, because it must not be moved back behind an accepted step.
 *
 * Reference: S. D. Cohen, A. C. Hindmarsh, CVODE, a stiff/nonstiff ODE solver in C, Comput. Phys.
 * 10 (1996) 138-143, doi:10.1063/1.4822377.
 */
#include "exchange.h"

enum { ONE_STEP = 2, FIRST_DERIVATIVE_FAILED = -9, TOO_CLOSE = -27 };

/* A simulation under way. */
typedef struct {
    Work *w;
    const Cvode *s;
    double time;          /* where the integrator is */
    size_t interval;      /* of the grid, which the FMU was last set in */
    size_t next_stop;     /* index of the grid time where it stops next */
    int status;           /* of the FMU's last call from within a step */
    int64_t left;         /* steps */
    int step_reported;    /* whether the FMU was told of the last step */
    int just_started, event_due;
    int64_t repeated;     /* events since the last step */
} Run;

typedef int OfVector(void *, void *);
typedef int OfNumber(void *, double);
typedef int OfNumberAndVector(void *, double, void *);
typedef int Integrate(void *, double, void *, double *, int);
typedef int Interpolate(void *, double, int, void *);
typedef double *DataOf(void *);

static void set_number(Function function, const Cvode *s, double value) {
    ((OfNumber *)function)(s->memory, value);
}

/* ---- callbacks --------------------------------------------------------------------------- */

/* Set time, states, and the inputs of that time; at a jump those of the side of the last call. */
static int set_at_solver_time(Run *run, double time, const double *x) {
    const Model *c = &run->w->model;
    size_t i = run->interval;
    while (i + 2 < c->n_times && time > c->times[i + 1]) i++;
    while (i > 0 && time < c->times[i]) i--;
    run->interval = i;
    return set_at(run->w, i, time, x);
}

/* What CVODE is told: 0, 1 to try a shorter step, -1 to give up. */
static int answer(Run *run, int status) {
    run->status = status;
    return status >= ERROR ? -1 : status >= DISCARD ? 1 : 0;
}

static int right_hand_side(Run *run, double time, const double *x, double *dx) {
    const Model *c = &run->w->model;
    TRY(set_at_solver_time(run, time, x));
    TRY(derivatives(c, ANY, dx));
    return OK;
}

int core_right_hand_side(double time, void *y, void *ydot, void *user_data) {
    Run *run = user_data;
    if (run->status >= ERROR) return -1;
    DataOf *const data = (DataOf *)run->s->vector_data;
    double *dx = data(ydot);
    const int said = answer(run, right_hand_side(run, time, data(y), dx));
    if (said != 0) return said;
    for (size_t j = 0; j < run->w->model.n_states; j++)
        if (!isfinite(dx[j])) return 1;
    return 0;
}

/* The Jacobian by directional derivatives, a column for each state. */
static int columns(Run *run, double time, const double *x, double *column) {
    const Fmu *f = &run->w->model.f;
    const size_t n = run->w->model.n_states;
    const double along = 1.0;
    TRY(set_at_solver_time(run, time, x));
    for (size_t j = 0; j < n; j++, column += n)
        TRY(get_directional_derivative(f, run->s->jacobian_derivatives, n,
                                       run->s->jacobian_states + j, 1, &along, column));
    return OK;
}

static int jacobian(double time, void *y, void *ydot, void *matrix, void *user_data, void *v1,
                    void *v2, void *v3) {
    Run *run = user_data;
    (void)ydot, (void)v1, (void)v2, (void)v3;
    const double *x = ((DataOf *)run->s->vector_data)(y);
    return answer(run, columns(run, time, x, ((DataOf *)run->s->matrix_data)(matrix)));
}

/* ---- stops at kinks and jumps ------------------------------------------------------------ */

static int has_reached(const Run *run, double time) {
    return fabs(run->time - time) <= time_resolution(run->time, time);
}

/* Restart the integrator from its present states, at a time. */
static void reinitialise(Run *run, double time) {
    const Cvode *s = run->s;
    run->time = time, run->just_started = 1;
    ((OfNumberAndVector *)s->reinit)(s->memory, time, s->state_vector);
}

/* Load the accepted states, and their tolerances, which CVODE copies. */
static void load_states(Run *run) {
    const Cvode *s = run->s;
    const size_t size = run->w->model.n_states * sizeof(double);
    memcpy(s->y, run->w->x, size);
    memcpy(s->z, run->w->atols, size);
    ((OfNumberAndVector *)s->set_tolerances)(s->memory, run->w->batch->settings->rtol,
                                             s->work_vector);
}

/* The next jump or kink of an input, or time event, which goes first. */
static double stop_time(const Run *run) {
    const double last = run->w->model.times[run->next_stop];
    return next_stop(run->w, last, time_resolution(last, last));
}

/* Whether a held input jumps at grid time i; linear ones have no slope of 0. */
static int has_jump(const Model *c, size_t i) {
    const size_t n = c->n_inputs;
    const double *now = c->values + i * n, *before = now - n, *slopes = c->slopes + (i - 1) * n;
    for (size_t j = 0; j < n; j++)
        if (now[j] != before[j] && slopes[j] == 0.0) return 1;
    return 0;
}

static int has_kink(const Model *c, size_t i) {
    const size_t n = c->n_inputs;
    const double *now = c->slopes + i * n, *before = now - n;
    for (size_t j = 0; j < n; j++)
        if (now[j] != before[j]) return 1;
    return has_jump(c, i);
}

/* At grid time i, reinitialise after a jump, and set the next time to stop at. */
static void set_next_stop(Run *run, size_t i) {
    const Model *c = &run->w->model;
    if (i == 0 || has_jump(c, i)) {
        load_states(run);
        reinitialise(run, larger(run->time, c->times[i]));
    }
    size_t stop = i + 1;
    while (stop + 1 < c->n_times && !has_kink(c, stop)) stop++;
    run->interval = i, run->next_stop = stop;
    set_number(run->s->set_stop_time, run->s, stop_time(run));
}

/* ---- steps ------------------------------------------------------------------------------- */

/* States at a part of the last step, into `trial`. */
static void interpolate_step(Work *w, double time, double h, double part, const void *how) {
    const Cvode *s = how;
    ((Interpolate *)s->interpolate)(s->memory, time + part * h, 0, s->work_vector);
    memcpy(w->trial, s->z, w->model.n_states * sizeof(double));
}

/* Go back to the first state event in the last step. */
static int find_state_event(Run *run, double begin) {
    Work *w = run->w;
    const double h = run->time - begin;
    double part;
    TRY(set_at_solver_time(run, run->time, run->s->y));
    TRY(find_event(w, run->next_stop - 1, begin, h, interpolate_step, run->s, &part));
    if (part <= 1.0) {
        run->time = begin + part * h, run->event_due = 1;
        memcpy(run->s->y, w->trial, w->model.n_states * sizeof(double));
    }
    return OK;
}

/* Take one step, to the next stop or event at most. Returns the code. */
static int step(Run *run) {
    const Cvode *s = run->s;
    if (run->left <= 0) return TOO_MANY_STEPS;
    run->left--;
    const double begin = run->time, stop = stop_time(run);
    const int flag = ((Integrate *)s->integrate)(s->memory, stop, s->state_vector, &run->time,
                                                 ONE_STEP);
    if (flag == TOO_CLOSE) { /* to start: in so short a time, nothing changes */
        reinitialise(run, stop);
    } else if (flag < 0) {
        if (run->status >= ERROR || (run->status >= DISCARD && flag == FIRST_DERIVATIVE_FAILED))
            return failed(STEP_FAILED, run->status);
        if (run->just_started) return STEP_TOO_SMALL;
        reinitialise(run, run->time); /* its history may be of no use behind a sharp edge */
        set_number(s->set_stop_time, s, stop);
        return FINISHED;
    } else if (!(run->time > begin)) {
        return STEP_TOO_SMALL;
    }
    run->step_reported = run->just_started = 0;
    const int status = run->w->model.f.n_indicators > 0 ? find_state_event(run, begin) : OK;
    return status >= DISCARD ? failed(STEP_FAILED, status) : FINISHED;
}

/* Tell the FMU that the last step is accepted, if it wants to know and does not yet; an event may
 * be due after it. */
static int report_step(Run *run) {
    if (run->time >= run->w->next_event) run->event_due = 1;
    if (!run->w->model.f.completes_steps || run->step_reported) return FINISHED;
    run->step_reported = 1;
    const int status = set_at_solver_time(run, run->time, run->s->y);
    const int code = status >= DISCARD ? failed(STEP_FAILED, status) : complete_step(run->w);
    if (code != EVENT) return code;
    run->event_due = 1;
    return FINISHED;
}

static int handle_due_event(Run *run) {
    Work *w = run->w;
    const size_t i = run->next_stop - 1;
    run->repeated = run->just_started ? run->repeated + 1 : 0;
    memcpy(w->x, run->s->y, w->model.n_states * sizeof(double));
    const int code = handle_event(w, i, i, run->time, run->repeated);
    load_states(run);
    reinitialise(run, run->time);
    run->event_due = 0, run->step_reported = 1;
    set_number(run->s->set_stop_time, run->s, stop_time(run));
    return code;
}

/* Step to grid time i, and put the states there into x. Returns the code. */
static int advance_to(Run *run, size_t i) {
    const Cvode *s = run->s;
    const double time = run->w->model.times[i];
    while (run->time < time || (run->event_due && has_reached(run, time))) {
        int code = report_step(run);
        if (code == FINISHED && run->event_due) {
            code = handle_due_event(run);
        } else if (code == FINISHED) {
            code = step(run);
            if (code == FINISHED && (run->time <= time || has_reached(run, time)))
                code = report_step(run);
        }
        if (code != FINISHED) return code;
    }
    const int passed = run->time > time && !has_reached(run, time);
    if (passed) ((Interpolate *)s->interpolate)(s->memory, time, 0, s->work_vector);
    memcpy(run->w->x, passed ? s->z : s->y, run->w->model.n_states * sizeof(double));
    return FINISHED;
}

static End along_grid(Run *run, double *y) {
    Work *w = run->w;
    const Model *c = &w->model;
    const Batch *b = w->batch;
    const size_t last = c->n_times - 1, n = c->n_states;
    int64_t all_steps = 0;
    for (size_t i = 0;; i++, y += c->n_outputs) {
        const double time = has_reached(run, c->times[i]) ? run->time : c->times[i];
        int code = handle_input_jump(w, i, time);
        if (code != FINISHED) return (End){code, run->time, i};
        const Interval a = interval(c, ANY, i);
        const int status = record(c, ANY, w, &a, time, y);
        if (status >= DISCARD) return (End){failed(OUTPUT_FAILED, status), time, i};
        if (w->bound < HUGE_VAL && is_above_bound(w, i, y)) return (End){ENDED_EARLY, time, i};
        if (b->states_out) memcpy(b->states_out + i * n, w->x, n * sizeof(double));
        if (i == last) break;
        if (i == run->next_stop) set_next_stop(run, i);
        const int64_t granted = run->left = steps_granted(b->settings, all_steps);
        code = advance_to(run, i + 1);
        all_steps += granted - run->left;
        code = limit_reached(b->settings, all_steps, code);
        if (code != FINISHED) return (End){code, run->time, i};
    }
    c->progress[STEPS] = all_steps;
    return (End){FINISHED, run->time, last};
}

End cvode_loop(Work *w, const double *point, double *y) {
    Run run = {.w = w, .s = w->batch->cvode, .time = w->model.times[0], .step_reported = 1};
    const Cvode *s = run.s;
    set_number(s->set_max_step, s, w->batch->settings->step); /* 0: no limit */
    ((OfVector *)s->set_user_data)(s->memory, &run);
    const int directional = s->jacobian_states != NULL && w->model.program == NULL;
    ((OfVector *)s->set_jacobian)(s->memory, directional ? (void *)(uintptr_t)jacobian : NULL);
    const int code = start_simulation(w, point);
    if (code != FINISHED) return (End){code, run.time, 0};
    return along_grid(&run, y);
}
