/* Values: those of the original pass through, unless effects touch them or they are this FMU's.
 *
 * Variables of FMI 3.0 are of more types than those of FMI 2.0 and may be arrays, of which each
 * element is a variable here; the original is given and asked for whole ones. */
#include "wrapper.h"

enum { REAL = 0, INTEGER = 6, BOOLEAN = 10 }; /* of the core's types */

/* What each type can hold, where integers of FMI 2.0 reach beyond it. */
static const struct {
    double low, high;
} ranges[N_TYPES] = {
    {-HUGE_VAL, HUGE_VAL}, {-HUGE_VAL, HUGE_VAL}, {-128, 127}, {0, 255}, {-32768, 32767},
    {0, 65535}, {-HUGE_VAL, HUGE_VAL}, {0, HUGE_VAL}, {-HUGE_VAL, HUGE_VAL}, {0, HUGE_VAL},
    {-HUGE_VAL, HUGE_VAL}};

/* A variable of the original: its first reference here, and its elements. */
typedef struct {
    uint32_t first;
    int32_t size, kept;
    Variables elements;
    Element plain;
} Found;

/* The place of a reference, or NULL for a scalar that keeps its type and reference. */
static const Place *place_of(const Table *t, uint32_t reference) {
    size_t low = 0, high = t->n_places;
    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (t->places[middle].first <= reference)
            low = middle + 1;
        else
            high = middle;
    }
    const Place *p = low > 0 ? &t->places[low - 1] : NULL;
    return p == NULL || reference - p->first >= (uint32_t)p->size ? NULL : p;
}

static void find_variable(const Table *t, uint32_t reference, int usual, Found *v) {
    const Place *p = place_of(t, reference);
    v->plain = (Element){usual, reference, 1, 0, 0};
    v->first = p ? p->first : reference;
    v->size = p ? p->size : 1;
    v->kept = p ? p->kept : NOT_KEPT;
    v->elements = (Variables){NULL, p ? t->elements + p->element : &v->plain, 0, (size_t)v->size};
}

static int all_plain(const Table *t, const uint32_t *vr, size_t n) {
    for (size_t i = 0; t->n_places > 0 && i < n; i++)
        if (place_of(t, vr[i]) != NULL) return 0;
    return 1;
}

static int read_numbers(Instance *c, const Found *v) {
    const Fmu *f = &c->original.f;
    if (f->get[v->elements.elements->type] == NULL) return ERROR;
    return get_elements(f, &v->elements, c->numbers, c->cells);
}

static int write_numbers(Instance *c, const Found *v) {
    const Fmu *f = &c->original.f;
    const int64_t type = v->elements.elements->type;
    if (f->set[type] == NULL) return ERROR;
    for (int32_t i = 0; i < v->size; i++)
        if (c->numbers[i] < ranges[type].low || c->numbers[i] > ranges[type].high)
            return complain(c, ERROR, "an integer is out of the range of its type in FMI 3.0");
    TRY(set_elements(f, &v->elements, c->numbers, c->cells));
    if (v->kept != NOT_KEPT && !c->now.readable)
        memcpy(c->kept_elements + v->kept, c->numbers, (size_t)v->size * sizeof(double));
    return OK;
}

/* What the elements of an array are that is to be set in part: nothing can be read at first. */
static int recall(Instance *c, const Found *v) {
    if (c->now.readable || v->kept == NOT_KEPT) return read_numbers(c, v);
    memcpy(c->numbers, c->kept_elements + v->kept, (size_t)v->size * sizeof(double));
    return OK;
}

static int get_numbers(Instance *c, int usual, const uint32_t *vr, size_t n, void *values) {
    Found v = {.size = 0};
    for (size_t i = 0; i < n; i++) {
        if (v.size == 0 || vr[i] - v.first >= (uint32_t)v.size) {
            find_variable(&c->table, vr[i], usual, &v);
            TRY(read_numbers(c, &v));
        }
        const double number = c->numbers[vr[i] - v.first];
        if (usual == REAL)
            ((double *)values)[i] = number;
        else if (number >= -2147483648.0 && number <= 2147483647.0)
            ((int32_t *)values)[i] = (int32_t)number;
        else
            return complain(c, ERROR, "an integer is too large for FMI 2.0");
    }
    return OK;
}

/* Elements of an array that follow each other are set together. */
static int set_numbers(Instance *c, int usual, const uint32_t *vr, size_t n, const void *values) {
    size_t count;
    for (size_t i = 0; i < n; i += count) {
        Found v;
        find_variable(&c->table, vr[i], usual, &v);
        const size_t element = vr[i] - v.first, size = (size_t)v.size;
        for (count = 1; i + count < n && element + count < size; count++)
            if (vr[i + count] != vr[i] + count) break;
        if (count < size) TRY(recall(c, &v));
        for (size_t j = 0; j < count; j++)
            c->numbers[element + j] = usual == REAL ? ((const double *)values)[i + j]
                                                    : ((const int32_t *)values)[i + j];
        TRY(write_numbers(c, &v));
    }
    return OK;
}

static int get_of(Instance *c, int type, const uint32_t *vr, size_t n, void *values) {
    const Fmu *f = &c->original.f;
    if (f->version == 3 && (type != REAL || !all_plain(&c->table, vr, n)))
        return get_numbers(c, type, vr, n, values);
    if (type == REAL) return get_reals(f, f->version, vr, n, values);
    return ((GetValues2 *)f->get[type])(f->handle, vr, n, values);
}

static int set_of(Instance *c, int type, const uint32_t *vr, size_t n, const void *values) {
    const Fmu *f = &c->original.f;
    if (f->version == 3 && (type != REAL || !all_plain(&c->table, vr, n)))
        return set_numbers(c, type, vr, n, values);
    if (type == REAL) return set_reals(f, f->version, vr, n, values);
    return ((SetValues2 *)f->set[type])(f->handle, vr, n, values);
}

static int set_texts(Instance *c, const uint32_t *vr, size_t n, const fmi2String *values) {
    const Fmu *f = &c->original.f;
    if (f->version == 2) return ((SetValues2 *)f->set_string)(f->handle, vr, n, values);
    return ((SetValues3 *)f->set_string)(f->handle, vr, n, values, n);
}

int get_row(Instance *c, double *row) {
    return get_of(c, REAL, c->table.row, c->table.n_row, row);
}

/* ---- start values ------------------------------------------------------------------------ */

/* The estimates that this FMU begins with, again: originals may set their own at set-up. */
int write_starts(Instance *c) {
    const Table *t = &c->table;
    if (t->n_starts > 0) TRY(set_of(c, REAL, t->starts, t->n_starts, c->starts));
    return t->n_varied > 0 ? set_of(c, REAL, t->varied, t->n_varied, c->base) : OK;
}

/* Those that are no reals. Not after set-up: an importer may have set others before it. */
int write_other_starts(Instance *c) {
    const Table *t = &c->table;
    const char *text = t->texts;
    if (t->n_integers > 0) TRY(set_of(c, INTEGER, t->integers, t->n_integers, t->integer_values));
    if (t->n_booleans > 0) TRY(set_of(c, BOOLEAN, t->booleans, t->n_booleans, t->boolean_values));
    for (size_t i = 0; i < t->n_strings; i++, text += strlen(text) + 1)
        TRY(set_texts(c, t->strings + i, 1, &text));
    return OK;
}

/* The sizes of arrays, which the run has chosen. */
int configure(Instance *c) {
    const Fmu *f = &c->original.f;
    const Variables *sizes = &c->experiment.structure;
    if (sizes->n_elements == 0) return OK;
    if (f->enter_configuration_mode == NULL || f->exit_configuration_mode == NULL) return ERROR;
    TRY(call(f->enter_configuration_mode, f->handle));
    TRY(set_elements(f, sizes, NULL, c->cells));
    return call(f->exit_configuration_mode, f->handle);
}

/* ---- the functions of the standard ------------------------------------------------------- */

/* In co-simulation, what is no input that moves may be set in event mode alone. */
static int open_for_discrete(Instance *c) {
    if (!c->simulates || !c->facts->exchange || c->now.phase != SIMULATING || c->now.in_event)
        return OK;
    if (c->now.dirty & MOVED) TRY(sync(c));
    return enter_event(c);
}

/* NULL for what is simply the original's. */
static inline const Answered *find_answered(const Instance *c, uint32_t reference) {
    if (LIKELY(c->n_direct > 0)) {
        if (reference >= c->n_direct) return NULL;
        const uint32_t place = c->direct[reference];
        return place > 0 ? &c->table.answered[place - 1] : NULL;
    }
    const Answered *low = c->table.answered;
    for (size_t n = c->table.n_answered; n > 0;) {
        const size_t half = n / 2;
        if (low[half].reference == reference) return low + half;
        if (low[half].reference < reference)
            low += half + 1, n -= half + 1;
        else
            n = half;
    }
    return NULL;
}

static int set_input(Instance *c, const Answered *a, double value) {
    const int ahead = c->work.model.changes_inputs || c->table.n_memories > 0;
    c->raw[a->index] = value;
    if (ahead || c->simulates) c->now.dirty |= NEW_INPUTS;
    if (ahead || (c->simulates && c->now.phase == SIMULATING)) return OK;
    return set_of(c, REAL, &a->reference, 1, &value);
}

RARELY static int set_answered(Instance *c, const Answered *a, double value) {
    const uint32_t reference = a->reference;
    switch (a->kind) {
    case SIGNAL:
        c->raw[a->index] = value;
        c->now.dirty |= NEW_INPUTS;
        return OK;
    case COEFFICIENT:
        c->coefficients[a->index] = value;
        c->now.dirty |= NEW_INPUTS, c->stale = 1;
        return OK;
    case BASE:
        c->base[a->index] = value;
        c->now.dirty |= NEW_INPUTS, c->stale = 1;
        return c->now.phase == SIMULATING ? OK : set_of(c, REAL, &reference, 1, &value);
    case START_VALUE:
    case OUTPUT:
        if (a->start >= 0) c->starts[a->start] = value;
        TRY(open_for_discrete(c));
        return set_of(c, REAL, &reference, 1, &value);
    default: return complain(c, ERROR, "this variable cannot be set");
    }
}

FMI2(SetReal)(VALUES(const fmi2Real)) {
    Instance *c = component;
    for (size_t i = 0; i < n; i++) {
        const Answered *a = find_answered(c, vr[i]);
        if (LIKELY(a != NULL && a->kind == INPUT)) {
            TRY(set_input(c, a, value[i]));
        } else if (a != NULL) {
            TRY(set_answered(c, a, value[i]));
        } else {
            TRY(open_for_discrete(c));
            TRY(set_of(c, REAL, vr + i, 1, value + i));
        }
    }
    return OK;
}

/* What holds instead of what the original says; it knows nothing of this FMU's references. */
RARELY static int get_answered(Instance *c, const Answered *a, double *value) {
    switch (a->kind) {
    case INPUT:
    case SIGNAL: *value = c->raw[a->index]; return OK;
    case COEFFICIENT: *value = c->coefficients[a->index]; return OK;
    case BASE: *value = c->base[a->index]; return OK;
    case STATE:
        *value = (size_t)a->index < c->table.n_nominals
                     ? c->work.x[a->index]
                     : c->outer[(size_t)a->index - c->table.n_nominals];
        return OK;
    case RATE:
        TRY(all_derivatives(c, c->found));
        *value = c->found[a->index];
        return OK;
    case OUTPUT:
        if (c->now.begun || c->now.phase < EVENTS) {
            TRY(output_rows(c, c->last));
            *value = c->last[a->index];
            return OK;
        } /* fall through */
    default: return get_of(c, REAL, &a->reference, 1, value);
    }
}

FMI2(GetReal)(VALUES(fmi2Real)) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    if (UNLIKELY(c->now.dirty != 0)) TRY(sync(c));
    for (size_t i = 0, plain; i < n; i += plain) {
        const Answered *a = find_answered(c, vr[i]);
        for (plain = 1; a == NULL && i + plain < n; plain++)
            if (find_answered(c, vr[i + plain]) != NULL) break;
        if (a != NULL)
            TRY(get_answered(c, a, value + i));
        else if (LIKELY(f->version == 2))
            TRY(get_reals(f, 2, vr + i, plain, value + i));
        else
            TRY(get_of(c, REAL, vr + i, plain, value + i));
    }
    return OK;
}

#define PASS(name, type)                       \
    FMI2(Get##name)(VALUES(fmi2##name)) {      \
        Instance *c = component;               \
        TRY(sync(c));                          \
        return get_of(c, type, vr, n, value);  \
    }                                          \
    FMI2(Set##name)(VALUES(const fmi2##name)) { \
        Instance *c = component;               \
        TRY(open_for_discrete(c));             \
        return set_of(c, type, vr, n, value);  \
    }
PASS(Integer, INTEGER)
PASS(Boolean, BOOLEAN)

FMI2(GetString)(VALUES(fmi2String)) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    TRY(sync(c));
    if (f->version == 2)
        return ((GetValues2 *)c->original.get_string)(f->handle, vr, n, value);
    return ((GetValues3 *)c->original.get_string)(f->handle, vr, n, value, n);
}

FMI2(SetString)(VALUES(const fmi2String)) {
    TRY(open_for_discrete(component));
    return set_texts(component, vr, n, value);
}

static int is_affected(const Table *t, const uint32_t *vr, size_t n) {
    for (size_t i = 0; i < t->n_affected; i++)
        for (size_t j = 0; j < n; j++)
            if (vr[j] == t->affected[i]) return 1;
    return 0;
}

/* Passed through where no effect touches what is asked for. */
FMI2(GetDirectionalDerivative)(fmi2Component component, const fmi2ValueReference unknown[],
                               size_t n_unknown, const fmi2ValueReference known[], size_t n_known,
                               const fmi2Real seed[], fmi2Real result[]) {
    Instance *c = component;
    const Table *t = &c->table;
    const Fmu *f = &c->original.f;
    if (f->get_directional_derivative == NULL)
        return complain(c, ERROR, "the original FMU gives no directional derivatives");
    if (is_affected(t, unknown, n_unknown) || is_affected(t, known, n_known))
        return complain(c, ERROR, "there are no directional derivatives where effects act");
    if (!all_plain(t, unknown, n_unknown) || !all_plain(t, known, n_known))
        return complain(c, ERROR, "there are no directional derivatives of elements of arrays");
    TRY(sync(c));
    return get_directional_derivative(f, unknown, n_unknown, known, n_known, seed, result);
}
