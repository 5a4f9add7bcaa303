/* Telling the original where it is, with inputs and parameters as the effects make them. */
#include "wrapper.h"

/* The registers where this FMU is: time, states and inputs, with what the effects make of them. */
static void set_registers(Instance *c) {
    Work *w = &c->work;
    refresh(c);
    FOR(j, w->model.n_states) w->trial[j] = w->x[j];
    interpolate_at(w, 0, c->now.time);
    *w->time = c->now.time;
    if (w->model.changes_inputs) run_fast(w->model.program->fast[BEFORE], w->r);
}

/* Hand over the inputs and parameters; those inputs that may jump only if `all`. */
int write_inputs(Instance *c, int all) {
    Work *w = &c->work;
    const Model *m = &w->model;
    const Variables *inputs = all ? &m->inputs : &m->continuous;
    if (LIKELY(m->program == NULL && c->times[0] == c->now.time))
        return set_values(&m->f, m->f.version, inputs, c->seen, w->buffer);
    set_registers(c);
    TRY(set_values(&m->f, m->f.version, inputs, w->effective, w->buffer));
    if (m->n_parameters == 0 || c->now.phase == INITIALISING) return OK;
    return set_reals(&m->f, m->f.version, m->parameters, m->n_parameters, w->varied);
}

/* The own states of effects inside at the start, where the original's are. */
static void start_own(Instance *c) {
    sample_inputs(c);
    refresh(c);
    interpolate_at(&c->work, 0, c->now.time);
    start_own_states(&c->work);
}

/* The inputs that the original is initialised with. Its states are not known yet and count as 0. */
int first_inputs(Instance *c) {
    Work *w = &c->work;
    memset(w->x, 0, w->model.n_states * sizeof *w->x);
    start_own(c);
    c->now.dirty = 0;
    return write_inputs(c, 1);
}

/* Tell the original the inputs, if it does not know them yet. */
int sync(Instance *c) {
    const int dirty = c->now.dirty, moved = dirty & MOVED;
    if (LIKELY(dirty == 0) || c->now.phase == INSTANTIATED) return OK;
    if (c->now.phase == INITIALISING) return first_inputs(c);
    c->now.dirty = 0;
    if (c->simulates)
        see_inputs(c, c->now.time, HUGE_VAL);
    else
        sample_inputs(c);
    refresh(c);
    if (moved) return set_at(&c->work, 0, c->now.time, c->work.x);
    return write_inputs(c, !c->facts->exchange || c->now.phase == EVENTS || c->now.in_event);
}

/* Start delays, own states and outputs, where the original's states are known. */
int begin(Instance *c) {
    if (c->now.begun) return OK;
    sample_inputs(c);
    memcpy(c->was, c->seen, c->table.n_raw * sizeof *c->was);
    note_inputs(c);
    start_own(c);
    c->now.begun = 1;
    c->now.dirty =
        c->work.model.changes_inputs || c->table.n_memories > 0 ? NEW_INPUTS : 0;
    if (c->table.n_output_effects == 0) return OK;
    TRY(sync(c));
    TRY(begin_outputs(c));
    return note_outputs(c);
}

/* In model exchange: dx/dt of every state, where the original stands. */
int all_derivatives(Instance *c, double *result) {
    TRY(sync(c));
    if (!c->simulates) sample_inputs(c);
    set_registers(c);
    TRY(derivatives(&c->work.model, ANY, result));
    if (c->n_outer == 0) return OK;
    TRY(output_rows(c, c->last));
    output_derivatives(c, result);
    return OK;
}

int enter_event(Instance *c) {
    TRY(call(c->original.f.enter_event_mode, c->original.f.handle));
    c->now.in_event = 1;
    return OK;
}

/* At the time where the original stands: to event mode, inputs, event iteration, and back. */
int handle_event_here(Instance *c) {
    Work *w = &c->work;
    int status;
    if (!c->now.in_event) TRY(enter_event(c));
    TRY(write_inputs(c, 1));
    const int code = iterate_event(w, &status);
    c->now.in_event = 0;
    c->now.proposed = 0.0;
    if (code != FINISHED) return explain(c, code);
    TRY(status);
    TRY(set_at(w, 0, c->now.time, w->x));
    return store_event_indicators(w);
}

int explain(Instance *c, int code) {
    const int status = code >= IS_FATAL ? FATAL : ERROR;
    switch (code % IS_FATAL) {
    case FINISHED: return OK;
    case TERMINATED: return c->now.ended = 1, DISCARD;
    case STEP_TOO_SMALL: return complain(c, status, "the solver's step became too small");
    case TOO_MANY_STEPS: return complain(c, status, "a step takes too many steps of the solver");
    case CHATTERING: return complain(c, status, "an event does not come to an end");
    default: return status;
    }
}
