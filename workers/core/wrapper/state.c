/* Getting, setting and serialising the whole state: this FMU's and the original's. */
#include <stdlib.h>

#include "wrapper.h"

typedef struct {
    Moment now;
    double *numbers; /* the instance's, then the core's */
    History *histories;
    fmi2FMUstate inner;
} Saved;

/* What the core keeps from its registers on; its orders, behind them, never change. */
static size_t n_of_core(const Instance *c) {
    return (size_t)((double *)c->work.orders - c->work.r);
}

static size_t n_numbers(const Instance *c) { return c->n_memory + n_of_core(c); }

static int lacking(const Instance *c) {
    return complain(c, ERROR, "the original FMU cannot get and set its state");
}

static int is_able(const Instance *c) {
    const Original *o = &c->original;
    return o->get_state != NULL && o->set_state != NULL && o->free_state != NULL;
}

static int no_memory(const Instance *c) { return complain(c, ERROR, "there is no memory left"); }

static void free_saved(const Instance *c, Saved *saved) {
    if (saved == NULL) return;
    for (size_t j = 0; j < c->n_histories && saved->histories != NULL; j++)
        history_clear(&saved->histories[j]);
    free(saved->histories);
    free(saved->numbers);
    free(saved);
}

static Saved *make_saved(const Instance *c) {
    Saved *saved = calloc(1, sizeof *saved);
    if (saved == NULL) return NULL;
    saved->numbers = calloc(n_numbers(c) + 1, sizeof *saved->numbers);
    saved->histories = calloc(c->n_histories + 1, sizeof *saved->histories);
    if (saved->numbers != NULL && saved->histories != NULL) return saved;
    free_saved(c, saved);
    return NULL;
}

static int copy_histories(const Instance *c, History *to, const History *from) {
    for (size_t j = 0; j < c->n_histories; j++)
        if (history_copy(&to[j], &from[j]) != 0) return no_memory(c);
    return OK;
}

FMI2(GetFMUstate)(fmi2Component component, fmi2FMUstate *state) {
    Instance *c = component;
    if (!is_able(c)) return lacking(c);
    Saved *saved = *state != NULL ? *state : make_saved(c);
    if (saved == NULL) return no_memory(c);
    *state = saved;
    c->now.next_event = c->work.next_event;
    saved->now = c->now;
    memcpy(saved->numbers, c->memory, c->n_memory * sizeof(double));
    memcpy(saved->numbers + c->n_memory, c->work.r, n_of_core(c) * sizeof(double));
    TRY(copy_histories(c, saved->histories, c->histories));
    return ((OfState *)c->original.get_state)(c->original.f.handle, &saved->inner);
}

FMI2(SetFMUstate)(fmi2Component component, fmi2FMUstate state) {
    Instance *c = component;
    const Saved *saved = state;
    if (!is_able(c) || saved == NULL) return lacking(c);
    TRY(copy_histories(c, c->histories, saved->histories));
    c->now = saved->now;
    c->work.next_event = c->now.next_event;
    memcpy(c->memory, saved->numbers, c->n_memory * sizeof(double));
    memcpy(c->work.r, saved->numbers + c->n_memory, n_of_core(c) * sizeof(double));
    c->stale = 1;
    return ((OfState *)c->original.set_state)(c->original.f.handle, saved->inner);
}

FMI2(FreeFMUstate)(fmi2Component component, fmi2FMUstate *state) {
    Instance *c = component;
    Saved *saved = *state;
    if (saved == NULL) return OK;
    int status = OK;
    if (saved->inner != NULL)
        status = ((OfState *)c->original.free_state)(c->original.f.handle, &saved->inner);
    free_saved(c, saved);
    *state = NULL;
    return status;
}

/* Bytes: how many numbers, the moment, the numbers, each history's length and segments, then the
 * original's. */
static size_t own_size(const Instance *c, const Saved *saved) {
    size_t size = 8 + sizeof saved->now + n_numbers(c) * sizeof(double);
    for (size_t j = 0; j < c->n_histories; j++)
        size += 8 + saved->histories[j].count * sizeof(Segment);
    return size;
}

FMI2(SerializedFMUstateSize)(fmi2Component component, fmi2FMUstate state, size_t *size) {
    Instance *c = component;
    Saved *saved = state;
    if (c->original.state_size == NULL || saved == NULL) return lacking(c);
    const int status = ((StateSize *)c->original.state_size)(c->original.f.handle, saved->inner,
                                                             size);
    *size += own_size(c, saved);
    return status;
}

static char *put(char *at, const void *from, size_t size) {
    if (size > 0) memcpy(at, from, size);
    return at + size;
}

FMI2(SerializeFMUstate)(fmi2Component component, fmi2FMUstate state, fmi2Byte bytes[],
                        size_t size) {
    Instance *c = component;
    const Saved *saved = state;
    const uint64_t n = n_numbers(c);
    if (c->original.serialise == NULL || saved == NULL || size < own_size(c, saved))
        return lacking(c);
    char *at = put(put(bytes, &n, 8), &saved->now, sizeof saved->now);
    at = put(at, saved->numbers, n * sizeof(double));
    for (size_t j = 0; j < c->n_histories; j++) {
        const uint64_t count = saved->histories[j].count;
        at = put(put(at, &count, 8), saved->histories[j].segments, count * sizeof(Segment));
    }
    return ((Serialise *)c->original.serialise)(c->original.f.handle, saved->inner, at,
                                                size - own_size(c, saved));
}

typedef struct {
    const char *at;
    size_t left;
} Input;

static int get(Input *from, void *to, size_t size) {
    if (size > from->left) return -1;
    if (size > 0) memcpy(to, from->at, size);
    from->at += size, from->left -= size;
    return 0;
}

static int read_own(const Instance *c, Input *from, Saved *saved) {
    uint64_t n;
    if (get(from, &n, 8) || n != n_numbers(c) || get(from, &saved->now, sizeof saved->now)
        || get(from, saved->numbers, n * sizeof(double)))
        return -1;
    for (size_t j = 0; j < c->n_histories; j++) {
        uint64_t count;
        if (get(from, &count, 8) || count > from->left / sizeof(Segment)) return -1;
        for (uint64_t i = 0; i < count; i++) {
            Segment s;
            if (get(from, &s, sizeof s)
                || history_note(&saved->histories[j], s.since, s.value, s.slope) != 0)
                return -1;
        }
    }
    return 0;
}

FMI2(DeSerializeFMUstate)(fmi2Component component, const fmi2Byte bytes[], size_t size,
                          fmi2FMUstate *state) {
    Instance *c = component;
    Input from = {bytes, size};
    if (!is_able(c) || c->original.deserialise == NULL) return lacking(c);
    Saved *saved = make_saved(c);
    if (saved == NULL) return no_memory(c);
    if (read_own(c, &from, saved) != 0) {
        free_saved(c, saved);
        return complain(c, ERROR, "these bytes are no state of this FMU");
    }
    *state = saved;
    return ((DeSerialise *)c->original.deserialise)(c->original.f.handle, from.at, from.left,
                                                    &saved->inner);
}
