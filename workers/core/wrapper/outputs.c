/* Effects at outputs: each sees what the ones before it have made of the outputs. */
#include "wrapper.h"

/* Room for two rows of each effect: what it saw when a step began, and when it ended. */
static double *row_of(const Instance *c, size_t e) { return c->rows + 2 * e * c->table.n_row; }

static History *history_of(const Instance *c, size_t e) {
    return &c->histories[c->table.n_memories + e];
}

/* Registers of an effect or of its motion: this time, the inputs at it, and a row. */
static void give_signals(const Instance *c, const Evaluated *e, const double *row) {
    double *u = e->r + e->p->first_input;
    const size_t n_raw = c->table.n_raw;
    FOR(j, n_raw) u[j] = c->seen[j] + (c->now.time - c->times[0]) * c->seen_slopes[j];
    memcpy(u + n_raw, row, c->table.n_row * sizeof *u);
    e->r[0] = c->now.time;
}

/* The history of a delay is what it was given, and that of a backlash is what it gave. */
static double remembered_output(const Instance *c, size_t e, double value) {
    const OutputEffect *effect = c->table.output_effects + e;
    const History *history = history_of(c, e);
    const double size = c->coefficients[effect->first_coefficient];
    if (effect->memory == DELAY) return history_at(history, c->now.time - size, c->now.time, value);
    if (history->count == 0) return value;
    const double last = history->segments[history->count - 1].value;
    return fmin(fmax(last, value - size), value + size);
}

static double result_of(const Instance *c, size_t e, const double *row) {
    const OutputEffect *effect = c->table.output_effects + e;
    const Output *o = c->outputs + e;
    const Evaluated *own = &o->effect;
    if (effect->memory != NO_HISTORY)
        return remembered_output(c, e, row[effect->column]);
    give_signals(c, own, row);
    memcpy(own->r + 1, o->run.x, own->p->n_own * sizeof *own->r);
    run_fast(own->p->fast[BEFORE], own->r);
    return own->r[own->p->first_parameter];
}

int output_rows(Instance *c, double *last) {
    const Table *t = &c->table;
    refresh(c);
    TRY(get_row(c, last));
    for (size_t e = 0; e < t->n_output_effects; e++) {
        memcpy(row_of(c, e) + t->n_row, last, t->n_row * sizeof *last);
        last[t->output_effects[e].column] = result_of(c, e, last);
    }
    return OK;
}

int begin_outputs(Instance *c) {
    const Table *t = &c->table;
    refresh(c);
    TRY(get_row(c, c->last));
    for (size_t e = 0; e < t->n_output_effects; e++) {
        Evaluated *own = &c->outputs[e].effect;
        if (t->output_effects[e].n_states > 0) {
            give_signals(c, own, c->last);
            run_fast(own->p->fast[START], own->r);
            memcpy(c->outputs[e].run.x, own->r + 1, own->p->n_own * sizeof *own->r);
        }
        c->last[t->output_effects[e].column] = result_of(c, e, c->last);
    }
    return OK;
}

/* Keep what the outputs are at a completed step, or where a communication step begins. */
int note_outputs(Instance *c) {
    const Table *t = &c->table;
    if (t->n_output_effects == 0) return OK;
    TRY(output_rows(c, c->last));
    for (size_t e = 0; e < t->n_output_effects; e++) {
        double *row = row_of(c, e);
        memcpy(row, row + t->n_row, t->n_row * sizeof *row);
        const OutputEffect *effect = t->output_effects + e;
        if (effect->memory == NO_HISTORY) continue;
        const double given = row[effect->column];
        const double noted = effect->memory == DELAY ? given : remembered_output(c, e, given);
        if (history_note(history_of(c, e), c->now.time, noted, 0.0) != 0)
            return complain(c, ERROR, "there is no memory left");
    }
    return OK;
}

/* In model exchange: derivatives of own states, after `output_rows`. */
void output_derivatives(Instance *c, double *result) {
    for (size_t e = 0, at = c->table.n_nominals; e < c->table.n_output_effects; e++) {
        const Output *o = c->outputs + e;
        const Program *p = o->effect.p;
        if (p == NULL) continue;
        give_signals(c, &o->effect, row_of(c, e) + c->table.n_row);
        memcpy(o->effect.r + 1, o->run.x, p->n_own * sizeof *o->run.x);
        run_fast(p->fast[AFTER], o->effect.r);
        FOR(j, p->n_sites) result[at + p->sites[j].state] = o->effect.r[p->sites[j].r];
        at += p->n_own;
    }
}

static double motion(const Instance *c, const Evaluated *e, const double *row, int which) {
    give_signals(c, e, row);
    run_fast(e->p->fast[BEFORE], e->r);
    return e->r[e->p->first_parameter + (uint32_t)which];
}

/* Own states over a step from times[0] on, which has just ended; within it outputs are linear. */
int advance_outputs(Instance *c) {
    const Table *t = &c->table;
    const double end = c->now.time;
    refresh(c);
    c->times[1] = end;
    TRY(get_row(c, c->last));
    for (size_t e = 0; e < t->n_output_effects; e++) {
        Output *o = c->outputs + e;
        double *begun = row_of(c, e), *ended = begun + t->n_row;
        memcpy(ended, c->last, t->n_row * sizeof *ended);
        if (t->output_effects[e].n_states > 0) {
            o->record.decay = motion(c, &o->motion, ended, 1);
            o->record.rate = motion(c, &o->motion, ended, 0);
            c->now.time = c->times[0];
            o->record.rate = larger(o->record.rate, motion(c, &o->motion, begun, 0));
            c->now.time = end;
            advance_output_states(&o->run, 0);
        }
        c->last[t->output_effects[e].column] = result_of(c, e, c->last);
    }
    return OK;
}
