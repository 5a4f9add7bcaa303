/* The life of an instance, and model exchange. */
#include "wrapper.h"

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

static const double coefficients[] = COEFFICIENTS;
static const double starts[] = STARTS;
static const double bases[] = BASES;
static const double raw_starts[] = RAW_STARTS;
static const double nominals[] = NOMINALS;

static void say(const Instance *c, fmi2Status status, const char *category, const char *text) {
    if (c->callbacks.logger != NULL)
        c->callbacks.logger(c->callbacks.componentEnvironment, c->name, status, category, "%s",
                            text);
}

/* Say what is wrong, and return the status. */
fmi2Status complain(Instance *c, fmi2Status status, const char *text) {
    say(c, status, "logStatusError", text);
    return status;
}

/* What the original says, with a prefix. */
static void pass_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                         fmi2String category, fmi2String message, ...) {
    char text[2048] = "original FMU: ";
    size_t prefix = strlen(text);
    va_list arguments;
    (void)name;
    va_start(arguments, message);
    vsnprintf(text + prefix, sizeof text - prefix, message == NULL ? "" : message, arguments);
    va_end(arguments);
    say(environment, status, category, text);
}

static void begin_again(Instance *c) {
    int j;
    for (j = 0; j < N_INPUT_MEMORIES + N_OUTPUT_EFFECTS; j++) history_clear(&c->histories[j]);
    memset(&c->now, 0, sizeof c->now);
    memcpy(c->now.coefficients, coefficients, N_COEFFICIENTS * sizeof(double));
    memcpy(c->now.starts, starts, N_STARTS * sizeof(double));
    memcpy(c->now.base, bases, N_BASE * sizeof(double));
    memcpy(c->now.raw, raw_starts, N_RAW * sizeof(double));
    for (j = 0; j < N_INNER; j++) c->now.atols[j] = fmax(SOLVER_ATOL * nominals[j], DBL_MIN);
    original_forget(&c->now.kept);
    c->now.next_event = HUGE_VAL;
    c->now.dirty = HAS_BEFORE || N_INPUT_MEMORIES > 0;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                              fmi2String resources, const fmi2CallbackFunctions *callbacks,
                              fmi2Boolean visible, fmi2Boolean logging) {
    Instance *c = calloc(1, sizeof *c);
    char why[1024];
    if (c == NULL || callbacks == NULL) return NULL;
    c->callbacks = *callbacks;
    c->name = malloc(strlen(name == NULL ? "" : name) + 1);
    if (c->name == NULL) return free(c), NULL;
    strcpy(c->name, name == NULL ? "" : name);
    c->inner = *callbacks;
    c->inner.logger = pass_message;
    c->inner.stepFinished = NULL;
    c->inner.componentEnvironment = c;
    c->simulates = type == fmi2CoSimulation;
    why[0] = '\0';
    if (guid == NULL || strcmp(guid, MODEL_GUID) != 0)
        snprintf(why, sizeof why, "the GUID must be %s but is another", MODEL_GUID);
    else if (!c->simulates && !ORIGINAL_EXCHANGE)
        snprintf(why, sizeof why, "this FMU is for co-simulation alone, as its original");
    else
        original_load(&c->original, &c->now.kept, resources, c->name, &c->inner, visible, logging,
                      why, sizeof why);
    begin_again(c);
    if (why[0] == '\0' && !AT_LEAST_DISCARD(write_starts(c))
        && !AT_LEAST_DISCARD(write_other_starts(c)))
        return c;
    if (why[0] != '\0') say(c, fmi2Error, "logStatusError", why);
    fmi2FreeInstance(c);
    return NULL;
}

void fmi2FreeInstance(fmi2Component component) {
    Instance *c = component;
    int j;
    if (c == NULL) return;
    original_free(&c->original);
    for (j = 0; j < N_INPUT_MEMORIES + N_OUTPUT_EFFECTS; j++) history_clear(&c->histories[j]);
    free(c->name);
    free(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean on, size_t n,
                               const fmi2String categories[]) {
    Instance *c = component;
    if (c->original.SetDebugLogging == NULL) return fmi2OK;
    return c->original.SetDebugLogging(c->original.handle, on, n, categories);
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerant, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean stops, fmi2Real stop) {
    Instance *c = component;
    fmi2Status status;
    if (!ORIGINAL_EXCHANGE && ORIGINAL_TOLERANCE > 0.0) { /* as in the run */
        tolerant = fmi2True;
        tolerance = ORIGINAL_TOLERANCE;
    } else if (ORIGINAL_EXCHANGE && c->simulates) {
        tolerant = fmi2False;
    }
    status = c->original.SetupExperiment(c->original.handle, tolerant, tolerance, start, stops,
                                         stop);
    c->now.time = start;
    if (AT_LEAST_DISCARD(status)) return status;
    return write_starts(c);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component) {
    Instance *c = component;
    c->now.phase = INITIALISING;
    return c->original.EnterInitializationMode(c->original.handle);
}

/* Start delays, own states and outputs, where the original's states are known. */
static fmi2Status begin(Instance *c) {
    fmi2Status status;
    if (c->now.begun) return fmi2OK;
    sample_inputs(c);
    take_inputs(c, c->now.time, c->now.was);
    note_inputs(c);
    begin_own_states(c);
    c->now.begun = 1;
    c->now.dirty = HAS_BEFORE || N_INPUT_MEMORIES > 0;
    status = N_OUTPUT_EFFECTS > 0 ? sync(c) : fmi2OK;
    if (!AT_LEAST_DISCARD(status)) status = begin_outputs(c);
    if (!AT_LEAST_DISCARD(status)) status = note_outputs(c);
    return status;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component) {
    Instance *c = component;
    fmi2Status status = first_inputs(c);
    if (!AT_LEAST_DISCARD(status)) status = c->original.ExitInitializationMode(c->original.handle);
    if (AT_LEAST_DISCARD(status)) return status;
#if ORIGINAL_EXCHANGE
    c->now.phase = c->simulates ? RUNNING : EVENTS;
    if (N_STATES > 0)
        status = c->original.GetContinuousStates(c->original.handle, c->now.states, N_STATES);
    if (!c->simulates || AT_LEAST_DISCARD(status)) return status;
    status = iterate_event(c);
    if (!AT_LEAST_DISCARD(status)) status = begin(c);
    if (!AT_LEAST_DISCARD(status)) status = note_signs(c);
    return status;
#else
    c->now.phase = RUNNING;
    return begin(c);
#endif
}

fmi2Status fmi2Terminate(fmi2Component component) {
    Instance *c = component;
    c->now.phase = ENDED;
    return c->original.Terminate(c->original.handle);
}

fmi2Status fmi2Reset(fmi2Component component) {
    Instance *c = component;
    fmi2Status status = c->original.Reset(c->original.handle);
    begin_again(c);
    if (!AT_LEAST_DISCARD(status)) status = write_starts(c);
    return AT_LEAST_DISCARD(status) ? status : write_other_starts(c);
}

#if ORIGINAL_EXCHANGE
fmi2Status fmi2EnterEventMode(fmi2Component component) {
    Instance *c = component;
    fmi2Status status = sync(c);
    c->now.phase = EVENTS;
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.EnterEventMode(c->original.handle);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info) {
    Instance *c = component;
    fmi2Status status = sync(c);
    if (!AT_LEAST_DISCARD(status)) status = c->original.NewDiscreteStates(c->original.handle, info);
    if (!AT_LEAST_DISCARD(status) && info->valuesOfContinuousStatesChanged && N_STATES > 0)
        status = c->original.GetContinuousStates(c->original.handle, c->now.states, N_STATES);
    c->now.dirty |= HAS_BEFORE;
    return status;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component) {
    Instance *c = component;
    fmi2Status status = sync(c);
    if (AT_LEAST_DISCARD(status)) return status;
    status = c->original.EnterContinuousTimeMode(c->original.handle);
    c->now.phase = RUNNING;
    if (!AT_LEAST_DISCARD(status)) status = begin(c);
    note_inputs(c);
    return status;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean keeps,
                                       fmi2Boolean *wants, fmi2Boolean *ends) {
    Instance *c = component;
    fmi2Status status = sync(c);
    note_inputs(c);
    if (!AT_LEAST_DISCARD(status)) status = note_outputs(c);
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.CompletedIntegratorStep(c->original.handle, keeps, wants, ends);
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time) {
    Instance *c = component;
    c->now.time = time;
    c->now.dirty |= HAS_BEFORE || N_INPUT_MEMORIES > 0;
    return c->original.SetTime(c->original.handle, time);
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real x[], size_t n) {
    Instance *c = component;
    if (n != N_ALL) return complain(c, fmi2Error, "the number of states is another");
    if (TOUCHES_EXCHANGE) memcpy(c->now.states, x, n * sizeof *x);
    c->now.dirty |= HAS_BEFORE;
    if (N_STATES == 0) return fmi2OK;
    return c->original.SetContinuousStates(c->original.handle, x, N_STATES);
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    if (n != N_ALL) return complain(c, fmi2Error, "the number of states is another");
    if (!TOUCHES_EXCHANGE && n > 0)
        return c->original.GetDerivatives(c->original.handle, result, n);
    return all_derivatives(c, result);
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    fmi2Status status = sync(c);
    if (AT_LEAST_DISCARD(status)) return status;
    return c->original.GetEventIndicators(c->original.handle, result, n);
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real x[], size_t n) {
    Instance *c = component;
    if (n != N_ALL) return complain(c, fmi2Error, "the number of states is another");
    if (n > N_STATES) memcpy(x + N_STATES, c->now.states + N_STATES, (n - N_STATES) * sizeof *x);
    if (N_STATES == 0) return fmi2OK;
    return c->original.GetContinuousStates(c->original.handle, x, N_STATES);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    size_t j;
    if (n != N_ALL) return complain(c, fmi2Error, "the number of states is another");
    for (j = N_STATES; j < n; j++) result[j] = 1.0;
    if (N_STATES == 0) return fmi2OK;
    return c->original.GetNominalsOfContinuousStates(c->original.handle, result, N_STATES);
}
#else
#define REFUSE(name, arguments, unused)                                               \
    fmi2Status fmi2##name arguments {                                                 \
        unused;                                                                       \
        return complain(component, fmi2Error, "this FMU is for co-simulation alone"); \
    }
#define ARRAY(name, type) \
    REFUSE(name, (fmi2Component component, type x[], size_t n), ((void)x, (void)n))
REFUSE(EnterEventMode, (fmi2Component component), (void)0)
REFUSE(NewDiscreteStates, (fmi2Component component, fmi2EventInfo *info), (void)info)
REFUSE(EnterContinuousTimeMode, (fmi2Component component), (void)0)
REFUSE(CompletedIntegratorStep,
       (fmi2Component component, fmi2Boolean keeps, fmi2Boolean *wants, fmi2Boolean *ends),
       ((void)keeps, (void)wants, (void)ends))
REFUSE(SetTime, (fmi2Component component, fmi2Real time), (void)time)
ARRAY(SetContinuousStates, const fmi2Real)
ARRAY(GetDerivatives, fmi2Real)
ARRAY(GetEventIndicators, fmi2Real)
ARRAY(GetContinuousStates, fmi2Real)
ARRAY(GetNominalsOfContinuousStates, fmi2Real)
#endif
