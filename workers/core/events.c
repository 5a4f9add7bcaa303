/* Events in model exchange: found between two steps, located, and handed to the FMU.
 *
 * A state event is where an event indicator goes from positive to not positive, or back (FMI 2.0.4,
 * section 3.1.1; FMI 3.0, section 3.1). It is located on the integrator's own interpolant, to
 * within what a CVODE root would be, and the simulation goes on from behind it.
 */
#include "exchange.h"

enum { MAX_EVENT_ITERATIONS = 100, MAX_REPEATED_EVENTS = 1000 };
static const double tolerance = 100.0 * 0x1p-52; /* of an event's time, over that time */

static int update_states(Work *w, int *code) {
    const Model *c = &w->model;
    const Fmu *f = &c->f;
    EventInfo *info = &w->info;
    int values_changed = 0, nominals_changed = 0;
    info->update_needed = 1;
    for (int n = 0; info->update_needed; n++) {
        if (n == MAX_EVENT_ITERATIONS) return *code = CHATTERING, OK;
        TRY(update_discrete_states(f, info));
        if (info->terminate) return *code = TERMINATED, OK;
        values_changed |= info->values_changed, nominals_changed |= info->nominals_changed;
    }
    w->next_event = info->next_defined ? info->next_time : HUGE_VAL;
    TRY(call(f->enter_continuous_time_mode, f->handle));
    if (values_changed) TRY(get_vector(f->get_continuous_states, f->handle, w->x, f->n_states));
    if (!nominals_changed) return OK;
    TRY(get_vector(f->get_nominals, f->handle, w->trial, f->n_states));
    for (size_t j = 0; j < f->n_states; j++)
        w->atols[j] = w->batch->settings->atol * fabs(w->trial[j]);
    return OK;
}

int iterate_event(Work *w, int *status) {
    int code = FINISHED;
    *status = update_states(w, &code);
    return code;
}

static int handle(Work *w, size_t before, size_t i, double time, int *code) {
    const Model *c = &w->model;
    const Fmu *f = &c->f;
    TRY(set_at(w, before, time, w->x));
    TRY(call(f->enter_event_mode, f->handle));
    if (c->n_inputs > 0) {
        interpolate_at(w, i, time);
        if (c->changes_inputs) run_fast(c->program->fast[BEFORE], w->r);
        TRY(set_values(f, f->version, &c->inputs, w->effective, w->buffer));
    }
    TRY(update_states(w, code));
    if (*code != FINISHED) return OK;
    TRY(set_at(w, i, time, w->x));
    return store_event_indicators(w);
}

int handle_event(Work *w, size_t before, size_t i, double time, int64_t repeated) {
    int code = FINISHED;
    if (repeated > MAX_REPEATED_EVENTS) return CHATTERING;
    const int status = handle(w, before, i, time, &code);
    return status < DISCARD ? code : failed(EVENT, status);
}

/* The event indicators of what the FMU is set to, into a row of `indicators`.
 *
 * Some FMUs compute nothing while they are set, nor when they are asked for indicators, which are
 * then those of an earlier time (some of OpenModelica's without states). All do when a variable is
 * got, so an output is got first. */
static int indicators_now(Work *w, int row) {
    const Fmu *f = &w->model.f;
    TRY(get_first(f, &w->model.outputs, w->buffer));
    return get_vector(f->get_event_indicators, f->handle, w->indicators[row], f->n_indicators);
}

int store_event_indicators(Work *w) {
    return w->model.f.n_indicators > 0 ? indicators_now(w, 0) : OK;
}

static int has_sign_changed(const Work *w) {
    int crossed = 0;
    for (size_t j = 0; j < w->model.f.n_indicators; j++)
        crossed |= (w->indicators[0][j] > 0.0) != (w->indicators[2][j] > 0.0);
    return crossed;
}

/* The first zero of the indicators, interpolated linearly, as a part of the bracket. */
static double first_zero(const Work *w) {
    double first = 1.0;
    for (size_t j = 0; j < w->model.f.n_indicators; j++) {
        const double one = w->indicators[0][j], other = w->indicators[1][j];
        if ((one > 0.0) != (other > 0.0))
            first = smaller(first, fabs(one) / (fabs(one) + fabs(other)));
    }
    return first;
}

/* Move one end of the bracket to the last trial. From the second move of it in a row on, the values
 * at the other end are halved, so that that one moves soon (the Illinois rule; M. Dowell, P.
 * Jarratt, BIT 11 (1971) 168-174, doi:10.1007/BF01934364). */
static void move_end(Work *w, int moved, int other, int times) {
    for (size_t j = 0; j < w->model.f.n_indicators; j++) {
        w->indicators[moved][j] = w->indicators[2][j];
        if (times > 1) w->indicators[other][j] *= 0.5;
    }
}

int find_event(Work *w, size_t i, double time, double h, Interpolant *interpolant, const void *how,
               double *part) {
    const size_t size = w->model.f.n_indicators * sizeof(double);
    *part = 2.0;
    TRY(indicators_now(w, 2));
    if (!has_sign_changed(w)) {
        memcpy(w->indicators[0], w->indicators[2], size);
        return OK;
    }
    memcpy(w->indicators[1], w->indicators[2], size);
    double low = 0.0, high = 1.0;
    int side = 0;
    const double width = smaller(0.5, tolerance * (fabs(time) + h) / h);
    for (int tries = 1; high - low > width; tries++) {
        const double guess = tries % 3 == 0 ? 0.5 : first_zero(w);
        const double at = low + smaller(larger(guess * (high - low), 0.5 * width),
                                        high - low - 0.5 * width);
        interpolant(w, time, h, at, how);
        TRY(set_at(w, i, time + at * h, w->trial));
        TRY(indicators_now(w, 2));
        if (has_sign_changed(w)) {
            high = at, side = side > 0 ? side + 1 : 1;
            move_end(w, 1, 0, side);
        } else {
            low = at, side = side < 0 ? side - 1 : -1;
            move_end(w, 0, 1, -side);
        }
    }
    if (high < 1.0) interpolant(w, time, h, high, how);
    *part = high;
    TRY(set_at(w, i, time + high * h, w->trial));
    return indicators_now(w, 2);
}

void dense_output(Work *w, double time, double h, double part, const void *how) {
    const DenseOutput *d = how;
    const size_t n = w->model.n_states;
    (void)time;
    for (size_t j = 0; j < n; j++) {
        double total = 0.0;
        for (size_t stage = 0; stage < d->n_stages; stage++) {
            double weight = 0.0;
            for (size_t power = d->n_powers; power-- > 0;)
                weight = (weight + d->weights[stage * d->n_powers + power]) * part;
            total += weight * w->k[stage * n + j];
        }
        w->trial[j] = w->x[j] + h * total;
    }
}
