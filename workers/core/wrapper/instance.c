/* The memory of an instance, and the core's in it. */
#include <float.h>
#include <stdlib.h>

#include "wrapper.h"

enum { LARGEST_DIRECT = 1 << 16 }; /* some tools give references of hundreds of millions */
static const char *const no_memory = "there is no memory left";
static const char *const other = "its parts do not fit each other";

/* Load a program with registers of its own; nothing if there are no bytes. */
static const char *load(Evaluated *e, const uint8_t *bytes, size_t n) {
    const char *wrong = NULL;
    if (n == 0) return NULL;
    e->p = core_program(bytes, n, &wrong);
    if (e->p == NULL) return wrong;
    e->r = calloc(e->p->n_registers + 1, sizeof *e->r);
    if (e->r == NULL) return no_memory;
    memcpy(e->r + e->p->first_constant, e->p->constants, e->p->n_constants * sizeof *e->r);
    return NULL;
}

static void unload(Evaluated *e) {
    core_program_free(e->p);
    free(e->r);
}

static const char *make_output(Instance *c, size_t number, double *row, double *outer) {
    const Table *t = &c->table;
    const OutputEffect *e = t->output_effects + number;
    Output *o = c->outputs + number;
    const char *wrong = NULL;
    const Bytes *programs = t->programs + 2 * number;
    wrong = load(&o->effect, programs[0].at, programs[0].n);
    if (wrong == NULL) wrong = load(&o->motion, programs[1].at, programs[1].n);
    const Program *p = o->effect.p, *motion = o->motion.p;
    if (wrong != NULL || p == NULL) return wrong != NULL || e->memory != NO_HISTORY ? wrong : other;
    const size_t n_seen = t->n_raw + t->n_row, own = p->n_own;
    if (p->n_states != own || own != (size_t)e->n_states || p->n_inputs != n_seen
        || p->n_parameters != 1 || p->n_base != 0 || (own > 0) != (motion != NULL)
        || p->n_coefficients != (uint32_t)e->n_coefficients)
        return other;
    if (motion != NULL
        && (motion->n_states != 0 || motion->n_inputs != n_seen || motion->n_parameters != 2
            || motion->n_base != 0 || motion->n_coefficients != p->n_coefficients))
        return other;
    o->record = (Record){c->times, c->seen, c->seen_slopes, 2, t->n_raw, t->n_row,
                         (size_t)e->column, p, NULL, 0.0, 0.0, row, NULL, 1};
    o->run = (OutputRun){.record = &o->record, .p = p, .r = o->effect.r, .x = outer};
    double *stages = calloc(4 * own + 1, sizeof *stages);
    if (stages == NULL) return no_memory;
    for (size_t stage = 0; stage < 4; stage++) o->run.stages[stage] = stages + stage * own;
    return NULL;
}

static int allocate(Instance *c) {
    const Table *t = &c->table;
    size_t largest = 1;
    const uint32_t last = t->n_answered > 0 ? t->answered[t->n_answered - 1].reference : 0;
    c->n_direct = last < LARGEST_DIRECT ? (size_t)last + 1 : 0;
    c->direct = calloc(c->n_direct + 1, sizeof *c->direct);
    if (c->direct == NULL) return -1;
    for (size_t i = 0; i < t->n_answered && c->n_direct > 0; i++)
        c->direct[t->answered[i].reference] = (uint32_t)i + 1;
    for (size_t i = 0; i < t->n_output_effects; i++)
        c->n_outer += (size_t)t->output_effects[i].n_states;
    for (size_t i = 0; i < t->n_places; i++)
        if ((size_t)t->places[i].size > largest) largest = (size_t)t->places[i].size;
    for (size_t i = 0; i < t->n_input_elements; i++)
        if ((size_t)t->input_elements[i].size > largest)
            largest = (size_t)t->input_elements[i].size;
    c->batch.largest_array = largest;
    c->n_memory = 0;
#define COUNT(name, n) c->n_memory += n;
    MOVING(COUNT, t)
    c->memory = calloc(c->n_memory + 1, sizeof *c->memory);
    double *at = c->memory;
    if (at == NULL) return -1;
#define PLACE(name, n) c->name = at, at += n;
    MOVING(PLACE, t)
    if (t->n_memories == 0) c->seen = c->raw, c->seen_slopes = c->slopes;
    c->n_histories = t->n_memories + t->n_output_effects;
    c->histories = calloc(c->n_histories + 1, sizeof *c->histories);
    c->outputs = calloc(t->n_output_effects + 1, sizeof *c->outputs);
    c->last = calloc(t->n_row + 1, sizeof *c->last);
    c->found = calloc(t->n_nominals + c->n_outer + 1, sizeof *c->found);
    c->numbers = calloc(largest, sizeof *c->numbers);
    c->cells = calloc(largest, sizeof(double));
    return c->histories && c->outputs && c->last && c->found && c->numbers && c->cells ? 0 : -1;
}

/* The core's own structures: an experiment of two times, which are those of a step. */
static void describe(Instance *c) {
    const Table *t = &c->table;
    const Facts *f = c->facts;
    const size_t n_continuous = (size_t)f->n_continuous;
    Fmu *fmu = &c->original.f;
    fmu->version = f->version, fmu->interpolates_inputs = f->interpolates;
    fmu->completes_steps = f->completes_steps, fmu->eventful = f->eventful;
    fmu->n_states = (size_t)f->n_states, fmu->n_indicators = (size_t)f->n_indicators;
    c->experiment = (Experiment){
        .structure = {NULL, t->structure, 0, t->n_structure},
        .inputs = {t->inputs, t->input_elements, t->n_inputs, t->n_input_elements},
        .continuous_inputs = {t->inputs, t->continuous_elements, n_continuous,
                              t->n_continuous_elements},
        .outputs = {t->output, NULL, t->n_output > 0, 0},
        .times = c->times, .intervals = c->interval, .values = c->seen, .slopes = c->seen_slopes,
        .n_times = 2, .n_inputs = t->n_raw};
    c->settings = (Settings){.step = t->solver->step, .rtol = t->solver->rtol,
                             .atol = t->solver->atol,
                             .max_steps = (int64_t)t->solver->max_steps};
    c->effects.parameters = t->varied;
    c->batch.fmu = fmu, c->batch.experiment = &c->experiment, c->batch.settings = &c->settings;
    c->batch.effects = &c->effects, c->batch.n_states = t->n_nominals;
    c->batch.progress = c->progress;
}

const char *make_instance(Instance *c) {
    const Table *t = &c->table;
    const char *wrong = NULL;
    c->facts = t->facts;
    if (allocate(c) != 0) return no_memory;
    describe(c);
    if (t->n_program > 0) {
        Program *p = core_program(t->program, t->n_program, &wrong);
        c->effects.program = p;
        if (p == NULL) return wrong;
        if (p->n_coefficients != t->n_coefficients || p->n_base != t->n_varied
            || p->n_parameters != t->n_varied)
            return other;
    }
    wrong = load(&c->rate, t->rate, t->n_rate);
    if (wrong != NULL) return wrong;
    if (c->rate.p != NULL
        && (c->rate.p->n_states != 0 || c->rate.p->n_inputs != 0 || c->rate.p->n_parameters != 1
            || c->rate.p->n_base != 0 || c->rate.p->n_coefficients != t->n_coefficients))
        return other;
    double *outer = c->outer;
    for (size_t e = 0; e < t->n_output_effects; outer += t->output_effects[e++].n_states) {
        wrong = make_output(c, e, c->rows + 2 * e * t->n_row, outer);
        if (wrong != NULL) return wrong;
    }
    const int refused = begin_work(&c->work, &c->batch);
    c->n_states = t->n_nominals + c->n_outer;
    return refused == NO_MEMORY ? no_memory : refused ? other : NULL;
}

void free_instance(Instance *c) {
    for (size_t j = 0; j < c->n_histories && c->histories != NULL; j++)
        history_clear(&c->histories[j]);
    for (size_t e = 0; e < c->table.n_output_effects && c->outputs != NULL; e++) {
        unload(&c->outputs[e].effect);
        unload(&c->outputs[e].motion);
        free(c->outputs[e].run.stages[0]);
    }
    unload(&c->rate);
    core_program_free((Program *)c->effects.program);
    end_work(&c->work);
    void *const owned[] = {c->histories, c->outputs, c->memory, c->last, c->found, c->numbers,
                           c->cells, c->name, c->direct};
    for (size_t i = 0; i < sizeof owned / sizeof *owned; i++) free(owned[i]);
    table_free(&c->table);
    free(c);
}

void begin_again(Instance *c) {
    const Table *t = &c->table;
    Work *w = &c->work;
    for (size_t j = 0; j < c->n_histories; j++) history_clear(&c->histories[j]);
    memset(&c->now, 0, sizeof c->now);
    memset(c->memory, 0, c->n_memory * sizeof *c->memory);
#define COPY(to, from) if (t->n_##from > 0) memcpy(c->to, t->from, t->n_##from * sizeof(double))
    COPY(coefficients, coefficients);
    COPY(starts, start_values);
    COPY(base, bases);
    COPY(raw, raw_starts);
    COPY(kept_elements, kept_elements);
    memset(w->trial, 0, t->n_nominals * sizeof *w->trial);
    memset(w->x, 0, t->n_nominals * sizeof *w->x);
    for (size_t j = 0; j < t->n_nominals; j++)
        w->atols[j] = larger(t->solver->atol * t->nominals[j], DBL_MIN);
    w->next_event = HUGE_VAL;
    c->stale = 1;
    c->now.dirty = w->model.changes_inputs || t->n_memories > 0 ? NEW_INPUTS : 0;
}

static void give_coefficients(const Instance *c, Evaluated *e, int32_t first) {
    if (e->p == NULL) return;
    memcpy(e->r + e->p->first_coefficient, c->coefficients + first,
           e->p->n_coefficients * sizeof *e->r);
    run_fast(e->p->fast[ONCE], e->r);
}

void refresh(Instance *c) {
    const Table *t = &c->table;
    Work *w = &c->work;
    const Program *p = w->model.program;
    if (LIKELY(!c->stale)) return;
    c->stale = 0;
    if (p != NULL) {
        memcpy(w->r + p->first_coefficient, c->coefficients, p->n_coefficients * sizeof *w->r);
        memcpy(w->r + p->first_base, c->base, p->n_base * sizeof *w->r);
        update_coefficients(w);
    }
    if (c->rate.p != NULL) {
        give_coefficients(c, &c->rate, 0);
        run_fast(c->rate.p->fast[BEFORE], c->rate.r);
        w->fastest_rate = c->rate.r[c->rate.p->first_parameter];
    }
    for (size_t e = 0; e < t->n_output_effects; e++) {
        give_coefficients(c, &c->outputs[e].effect, t->output_effects[e].first_coefficient);
        give_coefficients(c, &c->outputs[e].motion, t->output_effects[e].first_coefficient);
    }
}
