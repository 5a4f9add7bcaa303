/* Reading the file of a repaired FMU. Nothing in it is trusted: what is used as an index is
 * checked. */
#include "table.h"

#include <stdlib.h>
#include <string.h>

#include "system.h"

static const char mark[8] = "CEWRAP1";
static const char *const changed = "it is cut or was changed, or is of another version";

/* Of ISO 3309, bit by bit. */
static uint32_t crc_32(const uint8_t *bytes, size_t n) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < n; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

typedef struct {
    const uint8_t *at, *end;
    int wrong;
} Reader;

static const void *take(Reader *r, size_t item, size_t *count) {
    uint64_t size = 0;
    *count = 0;
    if (r->wrong || r->end - r->at < 8) return r->wrong = 1, NULL;
    memcpy(&size, r->at, sizeof size);
    const uint8_t *const begin = r->at + 8;
    const uint64_t left = (uint64_t)(r->end - begin);
    if (size > left || (size + 7) / 8 * 8 > left || size % item != 0) return r->wrong = 1, NULL;
    r->at = begin + (size + 7) / 8 * 8;
    *count = (size_t)size / item;
    return begin;
}

static int are_elements(const Element *e, size_t n, size_t n_columns) {
    for (size_t first = 0; first < n; first += (size_t)e[first].size) {
        if (e[first].size < 1 || (uint64_t)e[first].size > n - first) return 0;
        for (size_t i = first; i < first + (size_t)e[first].size; i++)
            if (e[i].type < 0 || e[i].type >= N_TYPES || e[i].column >= (int64_t)n_columns) return 0;
    }
    return 1;
}

static int is_below(int32_t index, size_t n) { return index >= 0 && (size_t)index < n; }

static int are_answered(const Table *t, size_t n_states) {
    const size_t limits[] = {t->n_raw, t->n_raw, t->n_coefficients, t->n_varied, t->n_starts,
                             n_states, t->n_row, n_states};
    for (size_t i = 0; i < t->n_answered; i++) {
        const Answered *a = t->answered + i;
        if (!is_below(a->kind, sizeof limits / sizeof *limits)) return 0;
        if (i > 0 && a->reference <= a[-1].reference) return 0;
        if (!is_below(a->index, limits[a->kind]) || a->start >= (int32_t)t->n_starts) return 0;
    }
    return 1;
}

static int are_places(const Table *t) {
    for (size_t i = 0; i < t->n_places; i++) {
        const Place *p = t->places + i;
        if (!is_below(p->element, t->n_elements) || p->size < 1) return 0;
        if ((size_t)p->size > t->n_elements - (size_t)p->element) return 0;
        if (t->elements[p->element].size != p->size) return 0;
        if (p->kept != NOT_KEPT
            && (!is_below(p->kept, t->n_kept_elements)
                || (size_t)p->size > t->n_kept_elements - (size_t)p->kept))
            return 0;
    }
    return 1;
}

static int are_effects(const Table *t, size_t *n_outer) {
    *n_outer = 0;
    for (size_t i = 0; i < t->n_memories; i++)
        if (!is_below(t->memories[i].column, t->n_raw)
            || !is_below(t->memories[i].coefficient, t->n_coefficients))
            return 0;
    for (size_t i = 0; i < t->n_output_effects; i++) {
        const OutputEffect *e = t->output_effects + i;
        if (!is_below(e->column, t->n_row) || e->n_states < 0 || e->n_coefficients < 0
            || e->first_coefficient < 0 || e->memory < NO_HISTORY || e->memory > BACKLASH
            || (e->memory != NO_HISTORY && e->n_coefficients == 0)
            || (size_t)e->first_coefficient + (size_t)e->n_coefficients > t->n_coefficients
            || (size_t)e->first_state != *n_outer)
            return 0;
        *n_outer += (size_t)e->n_states;
    }
    return 1;
}

static int is_text(const char *text, size_t n) { return n > 0 && text[n - 1] == '\0'; }

static int is_sound(const Table *t) {
    size_t n_outer, n_texts = 0;
    if (t->n_facts != 1 || t->n_solver != 1 || !is_text(t->guid, t->n_guid)
        || !is_text(t->original_guid, t->n_original_guid)
        || !is_text(t->identifier, t->n_identifier) || t->n_identifier > 256)
        return 0;
    for (size_t i = 0; i < t->n_texts; i++) n_texts += t->texts[i] == '\0';
    const Facts *f = t->facts;
    if ((f->version != 2 && f->version != 3) || f->n_states < 0 || f->n_indicators < 0
        || (size_t)f->n_states > t->n_nominals || f->n_continuous < 0
        || (size_t)f->n_continuous > t->n_inputs || t->n_inputs > t->n_raw
        || f->n_inputs < 0 || (size_t)f->n_inputs > t->n_raw)
        return 0;
    return t->n_raw == t->n_raw_starts && t->n_varied == t->n_bases
           && t->n_starts == t->n_start_values && t->n_integers == t->n_integer_values
           && t->n_booleans == t->n_boolean_values && t->n_strings == n_texts
           && (n_texts == 0 || is_text(t->texts, t->n_texts)) && are_effects(t, &n_outer)
           && are_answered(t, t->n_nominals + n_outer)
           && are_elements(t->input_elements, t->n_input_elements, t->n_raw)
           && are_elements(t->continuous_elements, t->n_continuous_elements, t->n_raw)
           && are_elements(t->structure, t->n_structure, 0)
           && are_elements(t->elements, t->n_elements, SIZE_MAX / 2) && are_places(t);
}

static const char *parse(Table *t, size_t n) {
    const uint8_t *bytes = t->content;
    uint32_t crc, length;
    if (n < 16 || memcmp(bytes, mark, sizeof mark) != 0) return changed;
    memcpy(&crc, bytes + 8, sizeof crc);
    memcpy(&length, bytes + 12, sizeof length);
    if (length != n - 16 || crc != crc_32(bytes + 16, n - 16)) return changed;
    Reader r = {bytes + 16, bytes + n, 0};
#define READ(type, name) t->name = take(&r, sizeof(type), &t->n_##name);
    ARRAYS(READ)
#undef READ
    if (r.wrong || !is_sound(t)) return changed;
    t->programs = calloc(2 * t->n_output_effects + 1, sizeof *t->programs);
    if (t->programs == NULL) return "there is no memory left";
    for (size_t i = 0; i < 2 * t->n_output_effects; i++)
        t->programs[i].at = take(&r, 1, &t->programs[i].n);
    return r.wrong || r.at != r.end ? changed : NULL;
}

const char *table_read(Table *table, const char *path) {
    size_t n = 0;
    memset(table, 0, sizeof *table);
    table->content = read_file(path, &n);
    return table->content == NULL ? "it cannot be read" : parse(table, n);
}

void table_free(Table *table) {
    free(table->programs);
    free(table->content);
}
