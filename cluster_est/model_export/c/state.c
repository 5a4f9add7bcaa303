/* Getting, setting and serialising the whole state: this FMU's and the original's. */
#include <stdlib.h>
#include <string.h>

#include "wrapper.h"

enum { HISTORIES = N_INPUT_MEMORIES + N_OUTPUT_EFFECTS };

typedef struct {
    Moving now;
    History histories[ROOM(HISTORIES)];
    fmi2FMUstate inner;
} Saved;

static int able(const Instance *c) {
    return c->original.GetFMUstate != NULL && c->original.SetFMUstate != NULL
           && c->original.FreeFMUstate != NULL;
}

static fmi2Status lacking(Instance *c) {
    return complain(c, fmi2Error, "the original FMU cannot get and set its state");
}

static fmi2Status copy_histories(Instance *c, History *to, const History *from) {
    int j;
    for (j = 0; j < HISTORIES; j++)
        if (history_copy(&to[j], &from[j]) != 0)
            return complain(c, fmi2Error, "there is no memory left");
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *state) {
    Instance *c = component;
    Saved *saved = *state;
    fmi2Status status;
    if (!able(c)) return lacking(c);
    if (saved == NULL) saved = calloc(1, sizeof *saved);
    if (saved == NULL) return complain(c, fmi2Error, "there is no memory left");
    *state = saved;
    saved->now = c->now;
    status = copy_histories(c, saved->histories, c->histories);
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.GetFMUstate(c->original.handle, &saved->inner);
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate state) {
    Instance *c = component;
    Saved *saved = state;
    fmi2Status status;
    if (!able(c) || saved == NULL) return lacking(c);
    status = copy_histories(c, c->histories, saved->histories);
    if (AT_LEAST_DISCARD(status)) return status;
    c->now = saved->now;
    return c->original.SetFMUstate(c->original.handle, saved->inner);
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *state) {
    Instance *c = component;
    Saved *saved = *state;
    fmi2Status status;
    int j;
    if (saved == NULL) return fmi2OK;
    status = c->original.FreeFMUstate(c->original.handle, &saved->inner);
    for (j = 0; j < HISTORIES; j++) history_clear(&saved->histories[j]);
    free(saved);
    *state = NULL;
    return status;
}

/* Bytes: the plain part, each history's length and segments, then the original's. */
static size_t own_size(const Saved *saved) {
    size_t size = sizeof saved->now;
    int j;
    for (j = 0; j < HISTORIES; j++)
        size += sizeof(size_t) + saved->histories[j].count * sizeof(Segment);
    return size;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate state, size_t *size) {
    Instance *c = component;
    Saved *saved = state;
    fmi2Status status;
    if (c->original.SerializedFMUstateSize == NULL || saved == NULL) return lacking(c);
    status = c->original.SerializedFMUstateSize(c->original.handle, saved->inner, size);
    *size += own_size(saved);
    return status;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate state, fmi2Byte bytes[],
                                 size_t size) {
    Instance *c = component;
    Saved *saved = state;
    fmi2Byte *at = bytes;
    int j;
    if (c->original.SerializeFMUstate == NULL || saved == NULL || size < own_size(saved))
        return lacking(c);
    memcpy(at, &saved->now, sizeof saved->now);
    at += sizeof saved->now;
    for (j = 0; j < HISTORIES; j++) {
        const History *history = &saved->histories[j];
        memcpy(at, &history->count, sizeof history->count);
        at += sizeof history->count;
        if (history->count > 0) memcpy(at, history->segments, history->count * sizeof(Segment));
        at += history->count * sizeof(Segment);
    }
    return c->original.SerializeFMUstate(c->original.handle, saved->inner, at,
                                         size - own_size(saved));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state) {
    Instance *c = component;
    const fmi2Byte *at = bytes, *end = bytes + size;
    Saved *saved;
    int j;
    if (!able(c) || c->original.DeSerializeFMUstate == NULL || size < sizeof saved->now)
        return lacking(c);
    saved = calloc(1, sizeof *saved);
    if (saved == NULL) return complain(c, fmi2Error, "there is no memory left");
    *state = saved;
    memcpy(&saved->now, at, sizeof saved->now);
    at += sizeof saved->now;
    for (j = 0; j < HISTORIES; j++) {
        History read = {NULL, 0, 0};
        size_t i;
        memcpy(&read.count, at, sizeof read.count);
        at += sizeof read.count;
        if (read.count > (size_t)(end - at) / sizeof(Segment))
            return complain(c, fmi2Error, "these bytes are no state of this FMU");
        for (i = 0; i < read.count; i++, at += sizeof(Segment)) {
            Segment segment;
            memcpy(&segment, at, sizeof segment);
            history_note(&saved->histories[j], segment.since, segment.value, segment.slope);
        }
    }
    return c->original.DeSerializeFMUstate(c->original.handle, at, (size_t)(end - at),
                                           &saved->inner);
}
