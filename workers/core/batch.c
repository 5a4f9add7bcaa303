/* The way in: the loop of a method, for all points of a batch up to the first that fails. */
#include "work.h"

static Loop *loop_of(const Work *w) {
    switch (w->batch->method) {
    case CO_SIMULATION: return co_simulation_loop(&w->model);
    case RUNGE_KUTTA: return runge_kutta_loop(&w->model);
    case DORMAND_PRINCE: return dormand_prince_loop(&w->model);
    default: return w->model.n_states == 0 ? dormand_prince_loop(&w->model) : cvode_loop;
    }
}

size_t core_simulate(const Batch *b) {
    Work work, *const w = &work;
    if (b->n_points == 0) return 0;
    const int refused = begin_work(w, b);
    if (refused) {
        put_end(b, 0, (End){refused, 0.0, 0});
        return 1;
    }
    Loop *const loop = loop_of(w);
    const size_t n_row = b->experiment->n_times * b->experiment->n_outputs;
    size_t p = 0;
    for (int code = FINISHED; p < b->n_points && code == FINISHED; p++) {
        select_point(w, p);
        code = put_end(b, p, loop(w, b->points + p * b->n_values, b->outputs + p * n_row));
        b->steps[p] = b->progress[STEPS];
    }
    end_work(w);
    return p;
}
