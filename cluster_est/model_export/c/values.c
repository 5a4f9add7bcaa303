/* Values: those of the original pass through, unless effects touch them or they are this FMU's. */
#include <stdlib.h>
#include <string.h>

#include "wrapper.h"

typedef enum { INPUT, SIGNAL, COEFFICIENT, BASE, START, RATE, OUTPUT, STATE } Kind;

#if N_SPECIALS > 0
typedef struct {
    fmi2ValueReference reference;
    Kind kind;
    int index;
    int start; /* index among the start values, or -1 */
} Special;

/* In the order of their references. */
static const Special specials[N_SPECIALS] = SPECIALS;

static int compare(const void *one, const void *other) {
    fmi2ValueReference a = ((const Special *)one)->reference;
    fmi2ValueReference b = ((const Special *)other)->reference;
    return (a > b) - (a < b);
}

static const Special *find(fmi2ValueReference reference) {
    Special wanted = {reference, INPUT, 0, -1};
    return bsearch(&wanted, specials, N_SPECIALS, sizeof *specials, compare);
}
#endif

/* The estimates that this FMU begins with, again: originals may set their own at set-up. */
fmi2Status write_starts(Instance *c) {
    fmi2Status status = fmi2OK;
#if N_STARTS > 0
    static const fmi2ValueReference references[] = START_REFERENCES;
    status = c->original.SetReal(c->original.handle, references, N_STARTS, c->now.starts);
#endif
#if N_BASE > 0
    static const fmi2ValueReference varied[] = BASE_REFERENCES;
    if (!AT_LEAST_DISCARD(status))
        status = c->original.SetReal(c->original.handle, varied, N_BASE, c->now.base);
#endif
    (void)c;
    return status;
}

/* Those that are no reals. Not after set-up: an importer may have set others before it. */
fmi2Status write_other_starts(Instance *c) {
    fmi2Status status = fmi2OK;
#define WRITE(type, count, given_references, given)                                              \
    if (count != 0 && !AT_LEAST_DISCARD(status)) {                                               \
        static const fmi2ValueReference references[] = given_references;                         \
        static const fmi2##type values[] = given;                                                \
        status = c->original.Set##type(c->original.handle, references, count, values);           \
    }
    WRITE(Integer, N_INTEGERS, INTEGER_REFERENCES, INTEGERS)
    WRITE(Boolean, N_BOOLEANS, BOOLEAN_REFERENCES, BOOLEANS)
    WRITE(String, N_STRINGS, STRING_REFERENCES, STRINGS)
#undef WRITE
    return status;
}

/* In co-simulation, what is no input that moves may be set in event mode alone. */
static fmi2Status open_for_discrete(Instance *c) {
#if ORIGINAL_EXCHANGE
    if (c->simulates && c->now.phase == RUNNING && !c->now.in_event) {
        c->now.in_event = 1;
        return c->original.EnterEventMode(c->original.handle);
    }
#else
    (void)c;
#endif
    return fmi2OK;
}

#if N_SPECIALS > 0
static fmi2Status set_special(Instance *c, const Special *special, double value) {
    fmi2ValueReference reference = special->reference;
    switch (special->kind) {
        case INPUT:
            c->now.raw[special->index] = value;
            c->now.dirty |= HAS_BEFORE || c->simulates || N_INPUT_MEMORIES > 0;
            if (HAS_BEFORE || N_INPUT_MEMORIES > 0) return fmi2OK;
            if (c->simulates && c->now.phase == RUNNING) return fmi2OK;
            return c->original.SetReal(c->original.handle, &reference, 1, &value);
        case SIGNAL:
            c->now.raw[special->index] = value;
            c->now.dirty = 1;
            return fmi2OK;
        case COEFFICIENT:
            c->now.coefficients[special->index] = value;
            c->now.dirty = 1;
            return fmi2OK;
        case BASE:
            c->now.base[special->index] = value;
            c->now.dirty = 1;
            if (c->now.phase == RUNNING) return fmi2OK;
            return c->original.SetReal(c->original.handle, &reference, 1, &value);
        case START:
        case OUTPUT: {
            fmi2Status status = open_for_discrete(c);
            if (special->start >= 0) c->now.starts[special->start] = value;
            if (AT_LEAST_DISCARD(status)) return status;
            return c->original.SetReal(c->original.handle, &reference, 1, &value);
        }
        default:
            return complain(c, fmi2Error, "this variable cannot be set");
    }
}
#endif

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real value[]) {
    Instance *c = component;
    fmi2Status status = fmi2OK, worst = fmi2OK;
    size_t i;
    if (!TOUCHES_EXCHANGE && !c->simulates && c->now.phase >= EVENTS)
        return c->original.SetReal(c->original.handle, vr, n, value);
    for (i = 0; i < n && !AT_LEAST_DISCARD(worst); i++) {
#if N_SPECIALS > 0
        const Special *special = find(vr[i]);
        if (special != NULL) {
            status = set_special(c, special, value[i]);
        } else
#endif
        {
            status = open_for_discrete(c);
            if (!AT_LEAST_DISCARD(status))
                status = c->original.SetReal(c->original.handle, &vr[i], 1, &value[i]);
        }
        if (status > worst) worst = status;
    }
    return worst;
}

#if N_SPECIALS > 0
/* Replace what the original says by what holds; it knows nothing of its own references. */
static fmi2Status get_special(Instance *c, const Special *special, double *value) {
    double result[ROOM(N_ALL)];
    fmi2Status status = fmi2OK;
    fmi2ValueReference reference = special->reference;
    switch (special->kind) {
        case INPUT:
        case SIGNAL:
            *value = c->now.raw[special->index];
            break;
        case COEFFICIENT:
            *value = c->now.coefficients[special->index];
            break;
        case BASE:
            *value = c->now.base[special->index];
            break;
        case STATE:
            *value = c->now.states[special->index];
            break;
        case START:
            status = c->original.GetReal(c->original.handle, &reference, 1, value);
            break;
        case RATE:
            status = all_derivatives(c, result);
            *value = result[special->index];
            break;
        case OUTPUT: {
            double rows[ROOM(N_OUTPUT_EFFECTS)][ROOM(N_ROW)], last[ROOM(N_ROW)];
            if (!c->simulates && N_INPUT_MEMORIES == 0) sample_inputs(c);
            if (c->now.begun || c->now.phase < EVENTS)
                status = output_rows(c, rows, last);
            else
                status = c->original.GetReal(c->original.handle, &reference, 1, last);
            *value = last[c->now.begun || c->now.phase < EVENTS ? special->index : 0];
            break;
        }
    }
    return status;
}
#endif

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference vr[], size_t n,
                       fmi2Real value[]) {
    Instance *c = component;
    fmi2Status status = sync(c), worst = status;
#if N_SPECIALS > 0
    size_t i, plain = !TOUCHES_EXCHANGE && !c->simulates ? n : 0;
    if (AT_LEAST_DISCARD(status)) return status;
    while (plain < n && find(vr[plain]) == NULL) plain++;
    if (plain == n) return c->original.GetReal(c->original.handle, vr, n, value);
    for (i = 0; i < n && !AT_LEAST_DISCARD(worst); i++) {
        const Special *special = find(vr[i]);
        status = special != NULL ? get_special(c, special, &value[i])
                                 : c->original.GetReal(c->original.handle, &vr[i], 1, &value[i]);
        if (status > worst) worst = status;
    }
    return worst;
#else
    if (AT_LEAST_DISCARD(worst)) return worst;
    return c->original.GetReal(c->original.handle, vr, n, value);
#endif
}

#define PASS(type)                                                                               \
    fmi2Status fmi2Get##type(fmi2Component component, const fmi2ValueReference vr[], size_t n,   \
                             fmi2##type value[]) {                                               \
        Instance *c = component;                                                                 \
        fmi2Status status = sync(c);                                                             \
        if (AT_LEAST_DISCARD(status)) return status;                                             \
        return c->original.Get##type(c->original.handle, vr, n, value);                          \
    }                                                                                            \
    fmi2Status fmi2Set##type(fmi2Component component, const fmi2ValueReference vr[], size_t n,   \
                             const fmi2##type value[]) {                                         \
        Instance *c = component;                                                                 \
        fmi2Status status = open_for_discrete(c);                                                \
        if (AT_LEAST_DISCARD(status)) return status;                                             \
        return c->original.Set##type(c->original.handle, vr, n, value);                          \
    }
PASS(Integer)
PASS(Boolean)
PASS(String)

/* Passed through where no effect touches what is asked for. */
fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknown[],
                                        size_t unknowns, const fmi2ValueReference known[],
                                        size_t knowns, const fmi2Real seed[], fmi2Real result[]) {
    static const fmi2ValueReference touched[] = TOUCHED_REFERENCES;
    Instance *c = component;
    fmi2Status status = sync(c);
    size_t i, j;
    if (c->original.GetDirectionalDerivative == NULL)
        return complain(c, fmi2Error, "the original FMU gives no directional derivatives");
    for (i = 0; i != N_TOUCHED; i++) {
        for (j = 0; j < unknowns + knowns; j++)
            if ((j < unknowns ? unknown[j] : known[j - unknowns]) == touched[i])
                return complain(c, fmi2Error,
                                "no directional derivatives are to be had where effects act");
    }
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.GetDirectionalDerivative(c->original.handle, unknown, unknowns, known,
                                                knowns, seed, result);
}
