/* Start of a simulation, jumps of inputs and accepted steps, for all methods of model exchange. */
#include "exchange.h"

int set_at(Work *w, size_t i, double time, const double *x) {
    const Model *c = &w->model;
    if (x != w->trial) memcpy(w->trial, x, c->n_states * sizeof *x);
    interpolate_at(w, i, time);
    return set_model(c, ANY, w, time);
}

int start_simulation(Work *w, const double *point) {
    const Model *c = &w->model;
    int status, code;
    memset(w->x, 0, c->n_states * sizeof *w->x);
    memcpy(w->atols, w->batch->settings->atols, c->n_states * sizeof *w->atols);
    initial_inputs(w);
    status = initialise(w, point, 0.0);
    if (status < DISCARD) {
        code = iterate_event(w, &status);
        if (code != FINISHED) return code;
    }
    if (status < DISCARD && c->f.n_states > 0)
        status = get_vector(c->f.get_continuous_states, c->f.handle, w->x, c->f.n_states);
    if (status < DISCARD) {
        start_own_states(w);
        status = store_event_indicators(w);
    }
    return status < DISCARD ? FINISHED : failed(INITIALISATION, status);
}

int complete_step(Work *w) {
    const Fmu *f = &w->model.f;
    if (!f->completes_steps) return FINISHED;
    const int status = completed_integrator_step(f, f->version, &w->info);
    if (status >= DISCARD) return failed(STEP_FAILED, status);
    if (w->info.ended) return TERMINATED;
    return w->info.event_needed ? EVENT : FINISHED;
}

int handle_input_jump(Work *w, size_t i, double time) {
    if (i == 0 || !w->model.f.eventful || !w->batch->experiment->jumps[i]) return FINISHED;
    return handle_event(w, i - 1, i, time, 0);
}

double next_stop(const Work *w, double last, double resolution) {
    const double event = w->next_event;
    /* not once before the grid time and once after */
    return event < last || fabs(event - last) <= resolution ? event : last;
}
