/* Forward sensitivities S = dx/dtheta, integrated on the steps that the states take.
 *
 * The states alone control the steps, so the trajectory keeps its bits. After each step its stages
 * are evaluated once more with
 *
 *     dS/dt = df/dx S + df/dtheta,    S(t0) = dx0/dtheta
 *
 * whose right-hand side is one directional derivative of the FMU for each parameter: along a column
 * of S, and along the parameter too where the FMU takes it as a known. Where it does not, df/dtheta
 * is a central difference between two further, perturbed instances of the FMU, initialised a little
 * above and below the value. S is the derivative of the discrete solution for fixed steps.
 *
 * Reference: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
 * section II.6 ("Dependence on initial values and parameters": internal differentiation).
 */
#include <stdlib.h>

#include "dormand_prince.h"
#include "exchange.h"

/* A Runge-Kutta method: c, a with rows of 6, and b. */
typedef struct {
    size_t n_stages;
    const double *c, *a, *b;
} Tableau;

static const double classic_c[] = {0.0, 0.5, 0.5, 1.0};
static const double classic_a[4][6] = {{0.0}, {0.5}, {0.0, 0.5}, {0.0, 0.0, 1.0}};
static const double classic_b[] = {1.0 / 6.0, 2.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0};
static const Tableau classic = {4, classic_c, classic_a[0], classic_b};
static const Tableau dormand_prince = {6, node, weight[0], weight[6]};

struct Forward {
    const Sensitivities *s;
    Tableau method;
    double *S, *stages;         /* (q, x), (stages, q, x) the columns of S, and their derivatives */
    double *x, *end, *seed;     /* states of a stage, of the step's end; direction in the knowns */
    double *result, *ends[2];   /* derivatives, and those of perturbed instances */
    double *point;
    uint32_t *knowns;           /* references of the states, and room for a parameter's */
    void *memory;
};

static int begin_forward(Forward *f, const Work *w, const Sensitivities *s) {
    const size_t n = w->model.n_states, q = s->n, k = w->batch->n_values;
    const size_t widest = n > s->n_outputs ? n : s->n_outputs;
    *f = (Forward){.s = s};
    f->method = w->batch->method == RUNGE_KUTTA ? classic : dormand_prince;
    double *m = calloc(q * n * (1 + f->method.n_stages) + 3 * n + 1 + 3 * widest + k + n + 1,
                       sizeof *m);
    if (m == NULL) return NO_MEMORY;
    f->memory = f->S = m, f->stages = f->S + q * n;
    f->x = f->stages + f->method.n_stages * q * n, f->end = f->x + n, f->seed = f->end + n;
    f->result = f->seed + n + 1, f->ends[0] = f->result + widest, f->ends[1] = f->ends[0] + widest;
    f->point = f->ends[1] + widest;
    f->knowns = (uint32_t *)(f->point + k);
    memcpy(f->knowns, s->states, n * sizeof *f->knowns);
    return FINISHED;
}

/* Let the model be another instance of the same FMU. */
static void use_instance(Work *w, void *handle) { w->model.f.handle = handle; }

/* The derivative of the unknowns along `seed` and, for a known, the parameter. */
static int directional(Forward *f, const Work *w, const uint32_t *unknowns, size_t n, size_t q) {
    size_t n_knowns = w->model.n_states;
    if (f->s->kinds[q] == KNOWN) {
        f->knowns[n_knowns] = f->s->references[q];
        f->seed[n_knowns++] = 1.0;
    }
    memset(f->result, 0, n * sizeof *f->result);
    if (n_knowns == 0 || n == 0) return OK;
    return get_directional_derivative(&w->model.f, unknowns, n, f->knowns, n_knowns, f->seed,
                                      f->result);
}

static void add_difference(Forward *f, size_t q, size_t n) {
    const double width = f->s->values[2 * q] - f->s->values[2 * q + 1];
    for (size_t j = 0; j < n; j++) f->result[j] += (f->ends[0][j] - f->ends[1][j]) / width;
}

/* One of the perturbed instances, at the stage's states: its derivatives, or outputs if
 * `outputs`. */
static int at_instance(Forward *f, Work *w, double time, size_t q, int side, int outputs) {
    const Model *c = &w->model;
    void *const own = c->f.handle;
    use_instance(w, f->s->handles[2 * q + (size_t)side]);
    memcpy(w->trial, f->x, c->n_states * sizeof *f->x);
    int status = set_model(c, ANY, w, time);
    if (status < DISCARD)
        status = outputs ? get_reals(&c->f, c->f.version, f->s->outputs, f->s->n_outputs,
                                     f->ends[side])
                         : get_vector(c->f.get_derivatives, c->f.handle, f->ends[side],
                                      c->f.n_states);
    use_instance(w, own);
    return status;
}

/* df/dx s + df/dtheta into `result`, s being `seed`. */
static int slope_of_column(Forward *f, Work *w, double time, size_t q) {
    const size_t n = w->model.n_states;
    TRY(directional(f, w, f->s->derivatives, n, q));
    if (f->s->kinds[q] != DIFFERENCES || n == 0) return OK;
    for (int side = 0; side < 2; side++) TRY(at_instance(f, w, time, q, side, 0));
    add_difference(f, q, n);
    return OK;
}

/* Evaluate one stage of all columns. */
static int advance_stage(Forward *f, Work *w, size_t i, size_t stage, double time, double h) {
    const size_t n = w->model.n_states, count = f->s->n;
    const double *a = f->method.a + stage * 6;
    for (size_t j = 0; j < n; j++) {
        double total = 0.0;
        for (size_t earlier = 0; earlier < stage; earlier++)
            total += a[earlier] * w->k[earlier * n + j];
        f->x[j] = w->x[j] + h * total;
    }
    const double at = time + f->method.c[stage] * h;
    TRY(set_at(w, i, at, f->x));
    for (size_t q = 0; q < count; q++) {
        for (size_t j = 0; j < n; j++) {
            double total = 0.0;
            for (size_t earlier = 0; earlier < stage; earlier++)
                total += a[earlier] * f->stages[(earlier * count + q) * n + j];
            f->seed[j] = f->S[q * n + j] + h * total;
        }
        TRY(slope_of_column(f, w, at, q));
        memcpy(f->stages + (stage * count + q) * n, f->result, n * sizeof *f->result);
    }
    return OK;
}

/* Set all instances to the end of the step, and complete it on perturbed ones. */
static int return_to_end(Forward *f, Work *w, size_t i, double time) {
    const Model *c = &w->model;
    void *const own = c->f.handle;
    TRY(set_at(w, i, time, f->end));
    for (size_t q = 0; c->f.completes_steps && q < f->s->n; q++) {
        if (f->s->kinds[q] != DIFFERENCES) continue;
        for (size_t side = 0; side < 2; side++) {
            use_instance(w, f->s->handles[2 * q + side]);
            int status = set_model(c, ANY, w, time);
            if (status < DISCARD) status = completed_integrator_step(&c->f, c->f.version, &w->info);
            use_instance(w, own);
            if (status >= DISCARD) return status;
        }
    }
    return OK;
}

/* Advance S over a step whose stages are in k, before it is accepted. */
int advance_sensitivities(Work *w, size_t i, double time, double h, Forward *f) {
    const size_t n = w->model.n_states, count = f->s->n;
    memcpy(f->end, w->trial, n * sizeof *f->end);
    for (size_t stage = 0; stage < f->method.n_stages; stage++)
        TRY(advance_stage(f, w, i, stage, time, h));
    for (size_t j = 0; j < count * n; j++) {
        double total = 0.0;
        for (size_t stage = 0; stage < f->method.n_stages; stage++)
            total += f->method.b[stage] * f->stages[stage * count * n + j];
        f->S[j] += h * total;
    }
    return return_to_end(f, w, i, time + h);
}

/* Record dy/dtheta at grid time i, which the FMU is set to. */
static int record_sensitivities(Forward *f, Work *w, size_t i) {
    const Sensitivities *s = f->s;
    const size_t n = w->model.n_states, n_all = w->model.n_outputs;
    for (size_t q = 0; q < s->n; q++) {
        double *to = s->sensitivities + (i * s->n + q) * n_all;
        memcpy(f->seed, f->S + q * n, n * sizeof *f->seed);
        memcpy(f->x, w->x, n * sizeof *f->x);
        for (size_t y = 0; y < n_all; y++)
            if (s->output_states[y] >= 0) to[y] = f->seed[s->output_states[y]];
        if (s->n_outputs == 0) continue;
        TRY(directional(f, w, s->outputs, s->n_outputs, q));
        if (s->kinds[q] == DIFFERENCES) {
            for (int side = 0; side < 2; side++)
                TRY(at_instance(f, w, w->model.times[i], q, side, 1));
            add_difference(f, q, s->n_outputs);
        }
        for (size_t a = 0; a < s->n_outputs; a++) to[s->output_positions[a]] = f->result[a];
    }
    return OK;
}

/* S(t0) by differences of initial states; perturbed instances are initialised too. */
static int start_sensitivities(Forward *f, Work *w) {
    const size_t n = w->model.n_states;
    void *const own = w->model.f.handle;
    for (size_t q = 0; q < f->s->n; q++) {
        const double *values = f->s->values + 2 * q;
        for (size_t side = 0; side < 2; side++) {
            memcpy(f->point, w->batch->points, w->batch->n_values * sizeof *f->point);
            f->point[f->s->positions[q]] = values[side];
            use_instance(w, f->s->handles[2 * q + side]);
            const int code = start_simulation(w, f->point);
            use_instance(w, own);
            if (code != FINISHED) return code;
            memcpy(f->ends[side], w->x, n * sizeof *w->x);
        }
        for (size_t j = 0; j < n; j++)
            f->S[q * n + j] = (f->ends[0][j] - f->ends[1][j]) / (values[0] - values[1]);
    }
    return FINISHED;
}

static End along_grid(Forward *f, Work *w) {
    const Model *c = &w->model;
    double *y = w->batch->outputs;
    Stepping now = {c->times[0], 0.0, 0};
    int code = start_sensitivities(f, w);
    if (code == FINISHED) code = start_simulation(w, w->batch->points);
    for (size_t i = 0; code == FINISHED; i++, y += c->n_outputs) {
        if (w->next_event <= c->times[c->n_times - 1]) return (End){HAS_EVENTS, now.time, i};
        const Interval a = interval(c, ANY, i);
        int status = record(c, ANY, w, &a, now.time, y);
        if (status >= DISCARD) return (End){failed(OUTPUT_FAILED, status), now.time, i};
        status = record_sensitivities(f, w, i);
        if (status >= DISCARD) return (End){failed(SENSITIVITIES_FAILED, status), now.time, i};
        if (i + 1 == c->n_times) return (End){FINISHED, now.time, i};
        now.left = w->batch->settings->max_steps;
        code = w->batch->method == RUNGE_KUTTA ? equal_steps(w, i, &now, f)
                                               : adaptive_steps(w, i, &now, f);
        if (code != FINISHED) return (End){code, now.time, i};
    }
    return (End){code, now.time, 0};
}

int core_sensitivities(const Batch *batch, const Sensitivities *s) {
    Work work, *const w = &work;
    Forward f = {0};
    int code = begin_work(w, batch);
    if (code == FINISHED) code = begin_forward(&f, w, s);
    End end = {code, 0.0, 0};
    if (code == FINISHED) {
        select_point(w, 0);
        end = along_grid(&f, w);
    }
    free(f.memory);
    end_work(w);
    return put_end(batch, 0, end);
}

int core_is_known(const Batch *batch, const uint32_t *unknowns, size_t n, uint32_t known,
                  double *derivatives) {
    Work work, *const w = &work;
    const double along = 1.0;
    int code = begin_work(w, batch), status = OK;
    if (code == FINISHED) code = start_simulation(w, batch->points);
    if (code == FINISHED)
        status = get_directional_derivative(&w->model.f, unknowns, n, &known, 1, &along,
                                            derivatives);
    end_work(w);
    batch->codes[0] = code;
    return status;
}
