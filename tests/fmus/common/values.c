/* The values of a model and who may touch them when, as the standard has it. */
#include <stdio.h>
#include <string.h>

#include "core.h"

typedef struct {
    const char *name;
    unsigned type;
    size_t offset, element, count;
    int sized_by;      /* value reference of the structural parameter that gives the count, or -1 */
    unsigned settable; /* the phases in which it may be set */
    bool computed;
} Variable;

typedef struct {
    int state, derivative;
    double nominal;
} Pair;

static const Variable VARIABLE[N_VARIABLES] = VARIABLES;
static const Pair PAIR[] = STATES; /* ends with a negative reference */
static const int INDICATOR[] = INDICATORS; /* likewise */

/* ---- variables ----------------------------------------------------------------------------- */

static size_t count_of(const Model *m, const Variable *variable)
{
    if (variable->sized_by < 0)
        return variable->count;
    const char *values = (const char *)&m->state.v;
    return (size_t)*(const UInt64 *)(values + VARIABLE[variable->sized_by].offset);
}

static const Variable *find(const Model *m, const char *function, unsigned reference,
                            unsigned types)
{
    if (reference >= N_VARIABLES)
        error(m, "%s: no variable has the value reference %u", function, reference);
    else if (!(VARIABLE[reference].type & types))
        error(m, "%s: %s has another type", function, VARIABLE[reference].name);
    else
        return &VARIABLE[reference];
    return NULL;
}

static void *locate(Model *m, unsigned reference, size_t *count)
{
    *count = count_of(m, &VARIABLE[reference]);
    return (char *)&m->state.v + VARIABLE[reference].offset;
}

const void *readable(Model *m, const char *function, unsigned reference, unsigned types,
                     size_t *count)
{
    const Variable *variable = find(m, function, reference, types);
    if (variable == NULL || require(m, RUNNING | CONFIGURATION, function) != OK ||
        (variable->computed && refresh(m) != OK))
        return NULL;
    return locate(m, reference, count);
}

void *writable(Model *m, const char *function, unsigned reference, unsigned types, size_t *count)
{
    const Variable *variable = find(m, function, reference, types);
    if (variable == NULL)
        return NULL;
    if (!(variable->settable & m->state.phase)) {
        error(m, "%s: %s cannot be set while the model is %s", function, variable->name,
              phase_name(m->state.phase));
        return NULL;
    }
    if (model_refuses(variable->name)) {
        error(m, "%s: %s is constant and cannot be set", function, variable->name);
        return NULL;
    }
    m->state.stale = true;
    m->state.slope[reference] = 0.0;
    m->state.updating = m->state.phase == EVENT_MODE;
    return locate(m, reference, count);
}

int get_numbers(Model *m, const char *function, const unsigned references[], size_t n,
                unsigned types, size_t element, void *values, size_t n_values)
{
    size_t done = 0, count;
    for (size_t i = 0; i < n; i++, done += count) {
        const void *source = readable(m, function, references[i], types, &count);
        if (source == NULL)
            return ERROR;
        if (done + count > n_values)
            return check_size(m, n_values, done + count, function);
        memcpy((char *)values + done * element, source, count * element);
    }
    return check_size(m, n_values, done, function);
}

/* A caller that sets what is no number at all, or no truth value, has a fault of its own. */
static bool sensible(unsigned type, const void *value)
{
    if (type == FLOAT64)
        return isfinite(*(const Float64 *)value);
    if (type == FLOAT32)
        return isfinite(*(const Float32 *)value);
    return type != BOOLEAN || *(const uint8_t *)value <= 1;
}

int set_numbers(Model *m, const char *function, const unsigned references[], size_t n,
                unsigned types, size_t element, const void *values, size_t n_values)
{
    size_t done = 0, count;
    for (size_t i = 0; i < n; i++, done += count) {
        char *target = writable(m, function, references[i], types, &count);
        if (target == NULL)
            return ERROR;
        if (done + count > n_values)
            return check_size(m, n_values, done + count, function);
        const Variable *variable = &VARIABLE[references[i]];
        for (size_t k = 0; k < count; k++) {
            const char *source = (const char *)values + (done + k) * element;
            if (!sensible(variable->type, source))
                return error(m, "%s: not a possible value of %s", function, variable->name);
            memcpy(target + k * element, source, element);
        }
    }
    return check_size(m, n_values, done, function);
}

int get_texts(Model *m, const char *function, const unsigned references[], size_t n,
              const char *values[], size_t n_values)
{
    size_t done = 0, count;
    for (size_t i = 0; i < n; i++, done += count) {
        const String *source = readable(m, function, references[i], STRING, &count);
        if (source == NULL)
            return ERROR;
        for (size_t k = 0; k < count && done + k < n_values; k++)
            values[done + k] = source[k];
    }
    return check_size(m, n_values, done, function);
}

int set_texts(Model *m, const char *function, const unsigned references[], size_t n,
              const char *const values[], size_t n_values)
{
    size_t done = 0, count;
    for (size_t i = 0; i < n; i++, done += count) {
        String *target = writable(m, function, references[i], STRING, &count);
        if (target == NULL)
            return ERROR;
        for (size_t k = 0; k < count && done + k < n_values; k++)
            snprintf(target[k], TEXT_SIZE, "%s", values[done + k]);
    }
    return check_size(m, n_values, done, function);
}

int set_slopes(Model *m, const char *function, const unsigned references[], size_t n,
               const int order[], const double values[])
{
    if (require(m, INSTANTIATED | INITIALIZATION | STEPPING, function) != OK)
        return ERROR;
    for (size_t i = 0; i < n; i++) {
        const Variable *variable = find(m, function, references[i], FLOAT64);
        if (variable == NULL)
            return ERROR;
        if (order[i] != 1)
            return error(m, "%s: order must be 1, is %d", function, order[i]);
        if (!(variable->settable & CONTINUOUS_TIME))
            return error(m, "%s: %s is not a continuous input", function, variable->name);
        m->state.slope[references[i]] = values[i];
    }
    return OK;
}

int directional(Model *m, const char *function, const unsigned unknowns[], size_t n_unknowns,
                const unsigned knowns[], size_t n_knowns, const double seed[],
                double sensitivity[])
{
    if (!DIRECTIONAL)
        return error(m, "%s: not provided", function);
    if (require(m, RUNNING, function) != OK)
        return ERROR;
    for (size_t i = 0; i < n_unknowns; i++) {
        sensitivity[i] = 0.0;
        for (size_t k = 0; k < n_knowns; k++) {
            if (!find(m, function, unknowns[i], FLOAT64) || !find(m, function, knowns[k], FLOAT64))
                return ERROR;
            const double partial = model_partial(m, unknowns[i], knowns[k]);
            if (isnan(partial))
                return error(m, "%s: not by variable %u", function, knowns[k]);
            sensitivity[i] += partial * seed[k];
        }
    }
    return OK;
}

/* The inputs run linearly from where `start` has them. */
void move_inputs(Model *m, const State *start, double offset)
{
    M(time) = start->v.time + offset;
    for (size_t i = 0; i < N_VARIABLES; i++)
        if (start->slope[i] != 0.0) {
            double *input = (double *)((char *)&m->state.v + VARIABLE[i].offset);
            const double *from = (const double *)((const char *)&start->v + VARIABLE[i].offset);
            *input = *from + start->slope[i] * offset;
        }
}


/* ---- continuous states --------------------------------------------------------------------- */

size_t count_states(const Model *m)
{
    size_t total = 0;
    for (const Pair *pair = PAIR; pair->state >= 0; pair++)
        total += count_of(m, &VARIABLE[pair->state]);
    return total;
}

static double *vector(Model *m, int reference, size_t *count)
{
    return locate(m, (unsigned)reference, count);
}

/* Copies the states, or their derivatives, one after the other. */
static void gather(Model *m, bool derivatives, double x[])
{
    for (const Pair *pair = PAIR; pair->state >= 0; pair++) {
        size_t count;
        const double *values = vector(m, derivatives ? pair->derivative : pair->state, &count);
        memcpy(x, values, count * sizeof *x);
        x += count;
    }
}

int core_set_states(Model *m, const char *function, const double x[], size_t n)
{
    if (require(m, CONTINUOUS_TIME, function) != OK ||
        check_size(m, n, count_states(m), function) != OK)
        return ERROR;
    for (size_t i = 0; i < n; i++)
        if (!isfinite(x[i]) && !model_takes_any_state())
            return error(m, "%s: state %zu is not finite at time %g", function, i, M(time));
    for (const Pair *pair = PAIR; pair->state >= 0; pair++) {
        size_t count;
        double *values = vector(m, pair->state, &count);
        memcpy(values, x, count * sizeof *x);
        x += count;
    }
    m->state.stale = true;
    return OK;
}

int core_get_states(Model *m, const char *function, double x[], size_t n)
{
    if (require(m, RUNNING, function) != OK || check_size(m, n, count_states(m), function) != OK)
        return ERROR;
    gather(m, false, x);
    return OK;
}

int core_get_derivatives(Model *m, const char *function, double x[], size_t n)
{
    if (require(m, RUNNING, function) != OK ||
        check_size(m, n, count_states(m), function) != OK || refresh(m) != OK)
        return ERROR;
    gather(m, true, x);
    return OK;
}

/* Models whose nominal values never change leave it at this. */
__attribute__((weak)) double model_nominal(Model *m, size_t state)
{
    (void)m;
    return PAIR[state].nominal;
}

int core_get_nominals(Model *m, const char *function, double x[], size_t n)
{
    size_t place = 0;
    if (require(m, INSTANTIATED | RUNNING, function) != OK ||
        check_size(m, n, count_states(m), function) != OK)
        return ERROR;
    for (size_t state = 0; PAIR[state].state >= 0; state++)
        for (size_t k = count_of(m, &VARIABLE[PAIR[state].state]); k > 0; k--)
            x[place++] = model_nominal(m, state);
    return OK;
}

int core_get_indicators(Model *m, const char *function, double z[], size_t n)
{
    if (require(m, RUNNING & ~(unsigned)STEPPING, function) != OK ||
        check_size(m, n, N_INDICATORS, function) != OK || (!model_is_lazy() && refresh(m) != OK))
        return ERROR;
    size_t count;
    for (size_t i = 0; i < n; i++)
        z[i] = *vector(m, INDICATOR[i], &count);
    return OK;
}
