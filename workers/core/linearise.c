/* Simulate a model and, at every time of the grid, its derivatives by central differences.
 *
 * With effects, the differences are those of the FMU together with its effects. An input is then
 * perturbed behind all of them, by an offset that is added at the end of the chain of effects, so
 * that an effect at a derivative that depends on an input sees the change as well. States, inputs
 * and parameters of the FMU are restored after each time, so that the trajectory keeps its bits.
 */
#include "linearise.h"

#include <stdlib.h>

/* Near the cube root of the rounding unit: there, rounding and curvature cost a central difference
 * equally little, some 1e-10 of the derivative. */
static const double relative_step = 1e-5;
enum { UPPER, LOWER };

static int begin_differences(Differences *d, Work *w, Work *offsets, const Linearisation *l) {
    const size_t x = w->model.n_states, y = w->model.n_outputs;
    *d = (Differences){.l = l, .w = w, .offsets = offsets};
    double *m = malloc((2 * x + 2 * y + 1) * sizeof *m);
    if (m == NULL) return NO_MEMORY;
    d->memory = m;
    for (int side = 0; side < 2; side++) {
        d->dx[side] = m + (size_t)side * x;
        d->y[side] = m + 2 * x + (size_t)side * y;
    }
    return FINISHED;
}

/* Derivatives and outputs where the FMU and the registers of `w` are, at one end. */
static int evaluate(Differences *d, Work *w, int side) {
    const Model *c = &w->model;
    TRY(derivatives(c, ANY, d->dx[side]));
    return get_values(&c->f, c->f.version, &c->outputs, d->y[side], w->buffer);
}

/* The same at a time and the states in `trial`, which are set first. */
static int evaluate_at(Differences *d, Work *w, double time, int side) {
    TRY(set_model(&w->model, ANY, w, time));
    return evaluate(d, w, side);
}

/* The two ends of a difference, within the bounds that the FMU declares. */
static void perturbed(double value, double nominal, const Range *range, size_t j, double *ends) {
    const double h = relative_step * larger(fabs(value), nominal);
    ends[UPPER] = smaller(value + h, larger(range->highs[j], value));
    ends[LOWER] = larger(value - h, smaller(range->lows[j], value));
    if (ends[UPPER] > ends[LOWER]) return;
    ends[UPPER] = value + h, ends[LOWER] = value - h;
}

/* Column j of two matrices with n columns. */
static void fill_column(const Differences *d, const double *ends, double *of_dx, double *of_y,
                        size_t j, size_t n) {
    const Model *c = &d->w->model;
    const double width = ends[UPPER] - ends[LOWER];
    for (size_t r = 0; r < c->n_states; r++)
        of_dx[r * n + j] = (d->dx[UPPER][r] - d->dx[LOWER][r]) / width;
    for (size_t r = 0; r < c->n_outputs; r++)
        of_y[r * n + j] = (d->y[UPPER][r] - d->y[LOWER][r]) / width;
}

static int by_states(Differences *d, Work *w, size_t i, double time) {
    const size_t n = w->model.n_states, m = w->model.n_outputs;
    double ends[2];
    memcpy(w->trial, d->w->x, n * sizeof *w->trial);
    for (size_t j = 0; j < n; j++) {
        const double x = d->w->x[j];
        perturbed(x, d->l->states.nominals[j], &d->l->states, j, ends);
        for (int side = 0; side < 2; side++) {
            w->trial[j] = ends[side];
            TRY(evaluate_at(d, w, time, side));
        }
        w->trial[j] = x;
        fill_column(d, ends, d->l->A + i * n * n, d->l->C + i * m * n, j, n);
    }
    return OK;
}

/* Let an input that would reach the FMU as `u` reach it as another value. */
static void set_input(Differences *d, Work *w, size_t j, double u, double value) {
    if (w->model.changes_inputs) {
        w->r[w->model.program->first_coefficient + d->l->first_offset + j] = value - u;
        update_coefficients(w);
    } else {
        w->u[j] = value;
    }
}

static int by_inputs(Differences *d, Work *w, size_t i, double time) {
    const size_t n = w->model.n_states, m = w->model.n_outputs, count = d->l->n_inputs;
    double ends[2];
    for (size_t j = 0; j < count; j++) {
        const double u = d->l->effective[i * count + j];
        perturbed(u, d->l->inputs.nominals[j], &d->l->inputs, j, ends);
        for (int side = 0; side < 2; side++) {
            set_input(d, w, j, u, ends[side]);
            TRY(evaluate_at(d, w, time, side));
        }
        set_input(d, w, j, u, u);
        fill_column(d, ends, d->l->B + i * n * count, d->l->D + i * m * count, j, count);
    }
    return OK;
}

static int by_parameters(Differences *d, Work *w, size_t i) {
    const Fmu *f = &w->model.f;
    const size_t n = w->model.n_states, m = w->model.n_outputs, count = d->l->parameters.n;
    double ends[2];
    for (size_t j = 0; j < count; j++) {
        const int64_t position = d->l->effect_positions[j];
        const double p = position >= 0 ? w->varied[position] : d->l->values[j];
        const double size = p != 0.0 ? fabs(p) : d->l->parameters.nominals[j];
        perturbed(p, size, &d->l->parameters, j, ends);
        for (int side = 0; side < 2; side++) {
            TRY(set_reals(f, f->version, d->l->references + j, 1, &ends[side]));
            TRY(evaluate(d, w, side));
        }
        TRY(set_reals(f, f->version, d->l->references + j, 1, &p));
        fill_column(d, ends, d->l->P + i * n * count, d->l->Q + i * m * count, j, count);
    }
    return OK;
}

/* Put the registers of the other program where those of the simulation are. */
static void follow(Differences *d) {
    Work *w = d->w, *o = d->offsets;
    if (o == w) return;
    memcpy(o->trial, w->trial, w->model.n_states * sizeof *w->trial);
    memcpy(o->u, w->u, w->model.n_inputs * sizeof *w->u);
    *o->time = *w->time;
}

int linearise_at(Differences *d, size_t i) {
    Work *w = d->w;
    const Model *c = &w->model;
    const double time = c->times[i];
    const size_t n = c->n_states, count = d->l->n_inputs;
    *w->time = time;
    TRY(derivatives(c, ANY, d->l->dx + i * n));
    memcpy(d->l->x + i * n, w->x, n * sizeof *w->x);
    memcpy(d->l->effective + i * count, w->effective, count * sizeof *w->effective);
    follow(d);
    TRY(by_states(d, d->offsets, i, time));
    memcpy(d->offsets->trial, w->x, n * sizeof *w->x);
    TRY(by_inputs(d, d->offsets, i, time));
    memcpy(w->trial, w->x, n * sizeof *w->x);
    TRY(set_model(c, ANY, w, time));
    TRY(by_parameters(d, w, i));
    return set_model(c, ANY, w, time); /* and the parameters that effects change */
}

/* Step to grid time i + 1 as `stepping` says. Returns the code. */
static int step_on_grid(const Differences *d, size_t i, Stepping *now) {
    Work *w = d->w;
    now->left = w->batch->settings->max_steps;
    if (d->l->stepping == DORMAND_PRINCE) return adaptive_steps(w, i, now, NULL);
    if (d->l->stepping == RUNGE_KUTTA) return equal_steps(w, i, now, NULL);
    const size_t n = w->model.n_states;
    now->time = w->model.times[i + 1];
    memcpy(w->x, d->l->x + (i + 1) * n, n * sizeof *w->x);
    return w->next_event <= now->time ? EVENT : FINISHED;
}

End along_grid(Differences *d, AtGridTime *what, void *how) {
    Work *w = d->w;
    const Model *c = &w->model;
    double *y = w->batch->outputs;
    Stepping now = {c->times[0], 0.0, 0};
    int code = start_simulation(w, w->batch->points);
    for (size_t i = 0; code == FINISHED; i++, y += c->n_outputs) {
        code = handle_input_jump(w, i, now.time);
        if (code != FINISHED) return (End){code, now.time, i};
        const Interval a = interval(c, ANY, i);
        int status = record(c, ANY, w, &a, now.time, y);
        if (status >= DISCARD) return (End){failed(OUTPUT_FAILED, status), now.time, i};
        status = what(d, i, now.time, y, how);
        if (status >= DISCARD) return (End){failed(LINEARISATION_FAILED, status), now.time, i};
        if (i + 1 == c->n_times) return (End){FINISHED, now.time, i};
        code = step_on_grid(d, i, &now);
        if (code != FINISHED) return (End){code, now.time, i};
    }
    return (End){code, now.time, 0};
}

int begin_pair(Paired *p, const Batch *batch, const Linearisation *l) {
    const int other = l->offsets->program != batch->effects->program;
    memset(p, 0, sizeof *p);
    p->batch = batch, p->offsets = *batch;
    p->offsets.effects = l->offsets;
    int code = begin_work(&p->work, batch);
    if (code == FINISHED && other) code = begin_work(&p->with_offsets, &p->offsets);
    if (code == FINISHED)
        code = begin_differences(&p->d, &p->work, other ? &p->with_offsets : &p->work, l);
    if (code != FINISHED) return code;
    if (other) {
        select_point(&p->with_offsets, 0);
        batch->progress[SIMULATIONS]--; /* it is one simulation */
    }
    select_point(&p->work, 0);
    return FINISHED;
}

int end_pair(Paired *p, End end) {
    free(p->d.memory);
    end_work(&p->with_offsets);
    end_work(&p->work);
    return put_end(p->batch, 0, end);
}

static int just_linearise(Differences *d, size_t i, double time, const double *y, void *how) {
    (void)time, (void)y, (void)how;
    return linearise_at(d, i);
}

int core_linearise(const Batch *batch, const Linearisation *l) {
    Paired p;
    const int code = begin_pair(&p, batch, l);
    return end_pair(&p, code == FINISHED ? along_grid(&p.d, just_linearise, NULL)
                                         : (End){code, 0.0, 0});
}
