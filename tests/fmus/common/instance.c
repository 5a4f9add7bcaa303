/* The life of an instance, its messages, and what models need not define. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"

static const Values START = START_VALUES;

/* ---- what models need not define ----------------------------------------------------------- */

#define OPTIONAL __attribute__((weak))

OPTIONAL void model_event(Model *m, Event *event) { (void)m, (void)event; }
OPTIONAL bool model_step_completed(Model *m) { (void)m; return false; }
OPTIONAL bool model_step_ends(Model *m) { (void)m; return false; }
OPTIONAL int model_answer(Model *m, const char *function)
{
    (void)m, (void)function;
    return OK;
}
OPTIONAL double model_partial(Model *m, unsigned unknown, unsigned known)
{
    (void)m, (void)unknown, (void)known;
    return 0.0;
}
OPTIONAL bool model_takes_any_state(void) { return false; }
OPTIONAL bool model_is_lazy(void) { return false; }
OPTIONAL double model_step_unit(void) { return 0.0; }
OPTIONAL double model_longest_step(void) { return INFINITY; }
OPTIONAL bool model_refuses(const char *name) { (void)name; return false; }
OPTIONAL int model_resources(Model *m, const char *location)
{
    (void)m, (void)location;
    return OK;
}
OPTIONAL int model_accept(Model *m) { (void)m; return OK; }
OPTIONAL void model_free(Model *m) { (void)m; }
OPTIONAL void model_start(Model *m) { (void)m; }
OPTIONAL void model_reset(Model *m, const Values *before) { (void)m, (void)before; }

/* ---- messages and checks ------------------------------------------------------------------- */

int error(const Model *m, const char *format, ...)
{
    char message[256];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    log_error(m, message);
    return ERROR;
}

const char *phase_name(unsigned phase)
{
    switch (phase) {
    case INSTANTIATED: return "instantiated";
    case CONFIGURATION: return "in configuration mode";
    case INITIALIZATION: return "in initialization mode";
    case EVENT_MODE: return "in event mode";
    case CONTINUOUS_TIME: return "in continuous-time mode";
    case STEPPING: return "in step mode";
    default: return "terminated";
    }
}

int require(const Model *m, unsigned phases, const char *function)
{
    if (!(m->state.phase & phases))
        return error(m, "%s: not allowed while the model is %s", function,
                     phase_name(m->state.phase));
    return OK;
}

int check_size(const Model *m, size_t size, size_t expected, const char *function)
{
    if (size == expected)
        return OK;
    return error(m, "%s: %zu values expected, got %zu", function, expected, size);
}

int refresh(Model *m)
{
    int status = m->state.stale ? model_equations(m) : OK;
    if (status != OK)
        return status;
    m->state.stale = false;
    return OK;
}

/* ---- life of an instance ------------------------------------------------------------------- */

static void begin(Model *m)
{
    memset(&m->state, 0, sizeof m->state); /* padding too: serialized states are bytes */
    memcpy(&m->state.v, &START, sizeof START);
    m->state.phase = INSTANTIATED;
    m->state.stale = true;
    m->state.next_event = INFINITY;
    m->state.last_event = -INFINITY;
    m->state.stop = INFINITY;
}

Model *core_new(const char *name, const char *token, const char *resources, bool co_simulation,
                const void *callbacks, void *environment)
{
    Model *m = calloc(1, sizeof *m);
    if (m == NULL)
        return NULL;
    m->co_simulation = co_simulation;
    m->callbacks = callbacks;
    m->environment = environment;
    m->instance_name = strdup(name != NULL && name[0] ? name : MODEL_NAME);
    begin(m);
    if (token == NULL || strcmp(token, MODEL_TOKEN) != 0)
        error(m, "instantiation: the GUID or token differs from " MODEL_TOKEN);
    else if (model_accept(m) == OK && model_resources(m, resources) == OK)
        return m;
    free(m->instance_name);
    free(m);
    return NULL;
}

void core_free(Model *m)
{
    if (m == NULL)
        return;
    model_free(m);
    free(m->instance_name);
    free(m);
}

int core_reset(Model *m)
{
    const Values before = m->state.v;
    begin(m);
    model_reset(m, &before);
    return OK;
}
