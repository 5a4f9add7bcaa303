/* The life of an original of FMI 3.0: its modes, steps and states. */
#include "model.h"

#include <stdlib.h>
#include <string.h>

#if ORIGINAL_FMI == 3
#include "original_fmi3.h"

static void pass_message(fmi3InstanceEnvironment environment, fmi3Status status,
                         fmi3String category, fmi3String message) {
    const Inner *o = environment;
    const fmi2CallbackFunctions *to = o->callbacks;
    if (to->logger != NULL)
        to->logger(to->componentEnvironment, "", as_2(status), category, "%s",
                   message == NULL ? "" : message);
}

/* The sizes of arrays, which the run has chosen. */
static fmi2Status configure(Inner *o) {
    static const struct { fmi2ValueReference reference; double value; } sizes[] = STRUCTURE;
    fmi2Status status;
    int i;
    if (N_STRUCTURE == 0) return fmi2OK;
    if (o->EnterConfigurationMode == NULL || o->ExitConfigurationMode == NULL) return fmi2Error;
    status = as_2(o->EnterConfigurationMode(o->instance));
    for (i = 0; i != N_STRUCTURE && status < fmi2Discard; i++)
        status = set_size(o, sizes[i].reference, sizes[i].value);
    return status < fmi2Discard ? as_2(o->ExitConfigurationMode(o->instance)) : status;
}

static fmi2Status SetDebugLogging_2(fmi2Component c, fmi2Boolean on, size_t n,
                                    const fmi2String categories[]) {
    Inner *o = c;
    return as_2(o->SetDebugLogging(o->instance, on != fmi2False, n, categories));
}

static fmi2Status SetupExperiment_2(fmi2Component c, fmi2Boolean tolerant, fmi2Real tolerance,
                                    fmi2Real start, fmi2Boolean stops, fmi2Real stop) {
    Kept *kept = ((Inner *)c)->kept;
    kept->tolerant = tolerant;
    kept->tolerance = tolerance;
    kept->start = start;
    kept->stops = stops;
    kept->stop = stop;
    return fmi2OK;
}

static fmi2Status EnterInitializationMode_2(fmi2Component c) {
    Inner *o = c;
    Kept *kept = o->kept;
    kept->initialised = 1;
    return as_2(o->EnterInitializationMode(o->instance, kept->tolerant != fmi2False,
                                           kept->tolerance, kept->start, kept->stops != fmi2False,
                                           kept->stop));
}

static fmi2Status Reset_2(fmi2Component c) {
    Inner *o = c;
    fmi2Status status = as_2(o->Reset(o->instance));
    return status < fmi2Discard ? configure(o) : status;
}

static void free_instance(fmi2Component c) {
    Inner *o = c;
    if (o->instance != NULL) o->FreeInstance(o->instance);
    free(o->cells);
    free(o);
}

/* Functions that have the same arguments in both versions. */
#define SAME(name, in_3, parameters, ...)                \
    static fmi2Status name##_2 parameters {              \
        Inner *o = c;                                    \
        return as_2(o->in_3(__VA_ARGS__));               \
    }
#define ALONE(name) SAME(name, name, (fmi2Component c), o->instance)
#define VECTOR(name, in_3, type) \
    SAME(name, in_3, (fmi2Component c, type x[], size_t n), o->instance, x, n)
ALONE(ExitInitializationMode)
ALONE(Terminate)
SAME(GetFMUstate, GetFMUState, (fmi2Component c, fmi2FMUstate *state), o->instance, state)
SAME(SetFMUstate, SetFMUState, (fmi2Component c, fmi2FMUstate state), o->instance, state)
SAME(FreeFMUstate, FreeFMUState, (fmi2Component c, fmi2FMUstate *state), o->instance, state)
SAME(SerializedFMUstateSize, SerializedFMUStateSize,
     (fmi2Component c, fmi2FMUstate state, size_t *size), o->instance, state, size)
SAME(SerializeFMUstate, SerializeFMUState,
     (fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size), o->instance, state,
     (fmi3Byte *)bytes, size)
SAME(DeSerializeFMUstate, DeserializeFMUState,
     (fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state), o->instance,
     (const fmi3Byte *)bytes, size, state)

/* ---- model exchange, or co-simulation ---------------------------------------------------- */

#if ORIGINAL_EXCHANGE
ALONE(EnterEventMode)
ALONE(EnterContinuousTimeMode)
SAME(SetTime, SetTime, (fmi2Component c, fmi2Real time), o->instance, time)
VECTOR(SetContinuousStates, SetContinuousStates, const fmi2Real)
VECTOR(GetDerivatives, GetContinuousStateDerivatives, fmi2Real)
VECTOR(GetEventIndicators, GetEventIndicators, fmi2Real)
VECTOR(GetContinuousStates, GetContinuousStates, fmi2Real)
VECTOR(GetNominalsOfContinuousStates, GetNominalsOfContinuousStates, fmi2Real)

static fmi2Status NewDiscreteStates_2(fmi2Component c, fmi2EventInfo *info) {
    Inner *o = c;
    bool again = false, ends = false, nominals = false, values = false, planned = false;
    fmi2Status status = as_2(o->UpdateDiscreteStates(o->instance, &again, &ends, &nominals,
                                                     &values, &planned, &info->nextEventTime));
    info->newDiscreteStatesNeeded = again;
    info->terminateSimulation = ends;
    info->nominalsOfContinuousStatesChanged = nominals;
    info->valuesOfContinuousStatesChanged = values;
    info->nextEventTimeDefined = planned;
    return status;
}

static fmi2Status CompletedIntegratorStep_2(fmi2Component c, fmi2Boolean keeps, fmi2Boolean *wants,
                                            fmi2Boolean *ends) {
    Inner *o = c;
    bool wanted = false, ended = false;
    fmi2Status status = as_2(
        o->CompletedIntegratorStep(o->instance, keeps != fmi2False, &wanted, &ended));
    *wants = wanted;
    *ends = ended;
    return status;
}
#define ADOPTED(X)                                                                                \
    X(EnterEventMode) X(EnterContinuousTimeMode) X(SetTime) X(SetContinuousStates)                \
    X(GetDerivatives) X(GetEventIndicators) X(GetContinuousStates)                                \
    X(GetNominalsOfContinuousStates) X(NewDiscreteStates) X(CompletedIntegratorStep)
#else
/* A step with which the original ends the simulation is discarded, as FMI 2.0 has it. */
static fmi2Status DoStep_2(fmi2Component c, fmi2Real point, fmi2Real size, fmi2Boolean keeps) {
    Inner *o = c;
    bool event = false, ends = false, early = false;
    fmi2Status status;
    o->kept->reached = point;
    status = as_2(o->DoStep(o->instance, point, size, keeps != fmi2False, &event, &ends, &early,
                            &o->kept->reached));
    o->kept->ended = ends;
    return (ends || early) && status < fmi2Discard ? fmi2Discard : status;
}

static fmi2Status GetRealStatus_2(fmi2Component c, fmi2StatusKind kind, fmi2Real *value) {
    (void)kind;
    *value = ((Inner *)c)->kept->reached;
    return fmi2OK;
}

static fmi2Status GetBooleanStatus_2(fmi2Component c, fmi2StatusKind kind, fmi2Boolean *value) {
    (void)kind;
    *value = ((Inner *)c)->kept->ended ? fmi2True : fmi2False;
    return fmi2OK;
}
#define ADOPTED(X) X(DoStep) X(GetRealStatus) X(GetBooleanStatus)
#endif

/* ---- making the instance ----------------------------------------------------------------- */

static const char *missing(const Inner *o) {
    if (o->FreeInstance == NULL) return "fmi3FreeInstance";
    if (o->GetFloat64 == NULL || o->SetFloat64 == NULL) return "fmi3SetFloat64";
    if (o->Reset == NULL) return "fmi3Reset";
    if (o->EnterInitializationMode == NULL) return "fmi3EnterInitializationMode";
#if ORIGINAL_EXCHANGE
    if (o->InstantiateModelExchange == NULL) return "fmi3InstantiateModelExchange";
    if (o->GetContinuousStateDerivatives == NULL && N_STATES > 0)
        return "fmi3GetContinuousStateDerivatives";
    if (o->UpdateDiscreteStates == NULL) return "fmi3UpdateDiscreteStates";
#else
    if (o->InstantiateCoSimulation == NULL) return "fmi3InstantiateCoSimulation";
    if (o->DoStep == NULL) return "fmi3DoStep";
#endif
    return NULL;
}

/* What the original may lack stays NULL here too. */
static void adopt(Original *original, const Inner *o) {
#define ADOPT(name) original->name = name##_2;
    ADOPT(GetReal) ADOPT(SetReal) ADOPT(GetInteger) ADOPT(SetInteger) ADOPT(GetBoolean)
    ADOPT(SetBoolean) ADOPT(GetString) ADOPT(SetString) ADOPT(SetupExperiment)
    ADOPT(EnterInitializationMode) ADOPT(ExitInitializationMode) ADOPT(Terminate) ADOPT(Reset)
    ADOPTED(ADOPT)
#define ADOPT_IF(name, in_3) \
    if (o->in_3 != NULL) original->name = name##_2;
    ADOPT_IF(SetDebugLogging, SetDebugLogging)
    ADOPT_IF(GetFMUstate, GetFMUState)
    ADOPT_IF(SetFMUstate, SetFMUState)
    ADOPT_IF(FreeFMUstate, FreeFMUState)
    ADOPT_IF(SerializedFMUstateSize, SerializedFMUStateSize)
    ADOPT_IF(SerializeFMUstate, SerializeFMUState)
    ADOPT_IF(DeSerializeFMUstate, DeserializeFMUState)
    ADOPT_IF(GetDirectionalDerivative, GetDirectionalDerivative)
#undef ADOPT
#undef ADOPT_IF
}

const char *original_bind(Original *original, void *look_up(void *library, const char *name)) {
    Inner *o = calloc(1, sizeof *o);
    const char *absent;
    void *found;
    if (o == NULL || (o->cells = calloc(LARGEST, sizeof(double))) == NULL)
        return free(o), "calloc";
    o->kept = original->kept;
#define FIND(name, arguments)                         \
    found = look_up(original->library, "fmi3" #name); \
    memcpy(&o->name, &found, sizeof found);
    FIND(InstantiateModelExchange, )
    FIND(InstantiateCoSimulation, )
    FIND(FreeInstance, )
    FMI3_FUNCTIONS(FIND)
#define FIND_BOTH(name, type) FIND(Get##name, ) FIND(Set##name, )
    FMI3_NUMBERS(FIND_BOTH)
#undef FIND
#undef FIND_BOTH
    original->handle = o;
    original->FreeInstance = free_instance;
    absent = missing(o);
    if (absent == NULL) adopt(original, o);
    return absent;
}

void original_instantiate(Original *original, const char *name, const char *resources,
                          const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                          fmi2Boolean logging) {
    Inner *o = original->handle;
    o->callbacks = callbacks;
#if ORIGINAL_EXCHANGE
    o->instance = o->InstantiateModelExchange(name, ORIGINAL_GUID, resources, visible != fmi2False,
                                              logging != fmi2False, o, pass_message);
#else
    o->instance = o->InstantiateCoSimulation(name, ORIGINAL_GUID, resources, visible != fmi2False,
                                             logging != fmi2False, false, false, NULL, 0, o,
                                             pass_message, NULL);
#endif
    if (o->instance != NULL && configure(o) < fmi2Discard) return;
    free_instance(o);
    original->handle = NULL;
}

void original_forget(Kept *kept) {
    static const double elements[N_ELEMENTS + 1] = ELEMENTS;
    memcpy(kept->elements, elements, sizeof elements);
}
#endif
