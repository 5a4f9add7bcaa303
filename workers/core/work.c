/* Memory, start and bounds of a simulation: what happens once. */
#include "work.h"

#include <stdlib.h>

static int sizes_fit(const Batch *b) {
    const Program *p = b->effects->program;
    const size_t own = p ? p->n_own : 0;
    if (b->fmu->version != 2 && b->fmu->version != 3) return 0;
    if (b->n_states != b->fmu->n_states + own || b->experiment->n_times == 0) return 0;
    return p == NULL || (p->n_states == b->n_states && p->n_inputs == b->experiment->n_inputs);
}

static Model model_of(const Batch *b) {
    const Experiment *e = b->experiment;
    const Program *p = b->effects->program;
    return (Model){
        .f = *b->fmu, .inputs = e->inputs, .continuous = e->continuous_inputs,
        .outputs = e->outputs, .times = e->times, .intervals = e->intervals, .values = e->values,
        .slopes = e->slopes, .n_times = e->n_times, .n_inputs = e->n_inputs,
        .n_outputs = e->n_outputs, .n_states = b->n_states, .program = p,
        .parameters = b->effects->parameters,
        .n_parameters = p && p->changes_inputs ? p->n_parameters : 0,
        .changes_inputs = p && p->changes_inputs, .progress = b->progress};
}

int begin_work(Work *w, const Batch *b) {
    memset(w, 0, sizeof *w);
    if (!sizes_fit(b)) return WRONG_SIZES;
    const Program *p = b->effects->program;
    const size_t x = b->n_states, u = b->experiment->n_inputs, z = b->fmu->n_indicators;
    const size_t registers = p ? p->n_registers : 1 + x + u;
    /* States and their derivatives begin at a cache line: those that cross one cost a third
     * more. */
    const size_t line = 8, room = (registers + 1 + line) / line * line;
    char *raw = calloc(room + 10 * x + u + 3 * z + b->largest_array + 1 + 2 * u + 3 * line,
                       sizeof(double));
    if (raw == NULL) return NO_MEMORY;
    w->memory = raw, w->batch = b, w->model = model_of(b);
    double *m = (double *)(raw + (64 - (uintptr_t)raw % 64) % 64) + line - 1;
    w->r = w->time = m, w->trial = m + 1, w->u = w->trial + x;
    w->effective = w->model.changes_inputs ? m + p->first_effective : w->u;
    w->varied = p ? m + p->first_parameter : NULL;
    w->k = m + 1 + room, w->x = w->k + 7 * x;
    w->atols = w->x + x, w->end = w->atols + x, w->input_slopes = w->end + x;
    for (int row = 0; row < 3; row++) w->indicators[row] = w->input_slopes + u + (size_t)row * z;
    w->buffer = w->indicators[0] + 3 * z;
    w->orders = (int32_t *)(w->buffer + b->largest_array + 1);
    for (size_t j = 0; j < u; j++) w->orders[j] = 1;
    w->seen = w->buffer + b->largest_array + 1 + u;
    w->model.at = (Places){w->r, w->time, w->trial, w->u, w->effective, w->varied, w->x, w->k};
    if (p) memcpy(m + p->first_constant, p->constants, p->n_constants * sizeof *m);
    w->next_event = HUGE_VAL, w->bound = HUGE_VAL;
    return FINISHED;
}

void end_work(Work *w) { free(w->memory); }

void select_point(Work *w, size_t point) {
    const Batch *b = w->batch;
    const Program *p = b->effects->program;
    b->progress[SIMULATIONS]++;
    b->progress[RUNNING] = 1;
    w->sum = 0.0;
    /* By 1e-9 it must be above its bound, which is compared with a sum in another order. */
    w->bound = b->bounds ? b->bounds[point] * (1.0 + 1e-9) : HUGE_VAL;
    if (p == NULL) return;
    const size_t n_c = p->n_coefficients, n_b = p->n_base;
    w->fastest_rate = b->effects->fastest_rates[point];
    if (n_c) memcpy(w->r + p->first_coefficient, b->effects->coefficients + point * n_c, n_c * 8);
    if (n_b) memcpy(w->r + p->first_base, b->effects->base + point * n_b, n_b * 8);
    update_coefficients(w);
}

void update_coefficients(Work *w) { run_fast(w->model.program->fast[ONCE], w->r); }

void interpolate_at(Work *w, size_t i, double time) {
    const Interval a = interval(&w->model, ANY, i);
    interpolate(&w->model, ANY, &a, time - a.begin);
}

int see_outputs(Work *w) {
    const Variables *v = &w->batch->experiment->seen;
    return get_values(&w->model.f, w->model.f.version, v, w->seen, w->buffer);
}

void hold_seen(Work *w) {
    const Variables *v = &w->batch->experiment->seen;
    FOR(j, v->n_reals) w->u[j] = w->seen[j];
    FOR(j, v->n_elements)
        if (v->elements[j].column >= 0)
            w->u[v->elements[j].column] = w->seen[v->elements[j].column];
}

void initial_inputs(Work *w) {
    const Model *c = &w->model;
    interpolate_at(w, 0, c->times[0]);
    *w->time = c->times[0];
    memset(w->trial, 0, c->n_states * sizeof *w->trial);
    if (!c->changes_inputs) return;
    run_fast(c->program->fast[START], w->r);
    run_fast(c->program->fast[BEFORE], w->r);
}

void start_own_states(Work *w) {
    const Model *c = &w->model;
    if (c->program == NULL) return;
    *w->time = c->times[0];
    memcpy(w->trial, w->x, c->n_states * sizeof *w->x);
    run_fast(c->program->fast[START], w->r);
    memcpy(w->x + c->f.n_states, w->trial + c->f.n_states,
           (c->n_states - c->f.n_states) * sizeof *w->x);
}

/* Structural parameters say how large arrays are. */
static int configure(Work *w, const double *point) {
    const Fmu *f = &w->model.f;
    TRY(call(f->enter_configuration_mode, f->handle));
    TRY(set_values(f, f->version, &w->batch->experiment->structure, point, w->buffer));
    return call(f->exit_configuration_mode, f->handle);
}

static int set_strings(const Fmu *f, const Experiment *e) {
    if (f->version == 2)
        return ((SetValues2 *)f->set_string)(f->handle, e->strings, e->n_strings, e->texts);
    return ((SetValues3 *)f->set_string)(f->handle, e->strings, e->n_strings, e->texts,
                                         e->n_strings);
}

/* In the order of the standard. Everything is written after each reset, because some FMUs do not
 * reset their parameters. */
int initialise(Work *w, const double *point, double tolerance) {
    const Fmu *f = &w->model.f;
    const Experiment *e = w->batch->experiment;
    const double start = e->times[0];
    TRY(call(f->reset, f->handle));
    if (e->structure.n_elements > 0) TRY(configure(w, point));
    if (f->version == 2) /* before the values, like most importers: some set defaults in it */
        TRY(set_up(f, f->setup_experiment, tolerance, start, e->stop));
    TRY(set_values(f, f->version, &e->numbers, point, w->buffer));
    if (e->n_strings > 0) TRY(set_strings(f, e));
    TRY(f->version == 2 ? call(f->enter_initialization_mode, f->handle)
                        : set_up(f, f->enter_initialization_mode, tolerance, start, e->stop));
    TRY(set_values(f, f->version, &e->inputs, w->effective, w->buffer));
    return call(f->exit_initialization_mode, f->handle);
}

int is_above_bound(Work *w, size_t i, const double *y) {
    const Experiment *e = w->batch->experiment;
    for (int64_t k = i > 0 ? e->row_ends[i - 1] : 0; k < e->row_ends[i]; k++) {
        const int64_t place = e->by_time[k];
        const double simulated = y[e->gather[place] - (int64_t)(i * e->n_outputs)];
        const double residual = (e->measured[place] - simulated) / e->sigmas[place];
        w->sum += residual * residual;
    }
    return w->sum > w->bound;
}

int64_t n_steps(double length, double longest, int64_t limit) {
    if (longest <= 0.0) return 1;
    const double needed = length / longest - 1e-9;
    if (!(needed < (double)limit)) return limit + 1;
    return needed <= 1.0 ? 1 : (int64_t)ceil(needed);
}

/* Eight for each time constant. */
int64_t substep_count(double length, double rate) {
    const double wanted = ceil(8.0 * length * rate);
    return wanted >= 1e4 ? 10000 : wanted > 1.0 ? (int64_t)wanted : 1;
}

int put_end(const Batch *b, size_t p, End end) {
    b->codes[p] = end.code;
    b->stopped_at[p] = end.time;
    b->indices[p] = (int64_t)end.index;
    return end.code;
}
