/* The FMI 2.0 API over core.c. */
#include <stdlib.h>

#include "core.h"
#include "fmi2Functions.h"

void log_error(const Model *m, const char *message)
{
    const fmi2CallbackFunctions *callbacks = m->callbacks;
    if (callbacks != NULL && callbacks->logger != NULL)
        callbacks->logger(callbacks->componentEnvironment, m->instance_name, fmi2Error,
                          "logStatusError", "%s", message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n,
                               const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories; /* there are only errors, always logged */
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                              fmi2String resources, const fmi2CallbackFunctions *callbacks,
                              fmi2Boolean visible, fmi2Boolean logging_on)
{
    (void)visible;
    Model *m = core_new(name, guid, resources, type == fmi2CoSimulation, callbacks, NULL);
    if (m != NULL)
        m->logging_on = logging_on;
    return m;
}

void fmi2FreeInstance(fmi2Component c) { core_free(c); }
fmi2Status fmi2Reset(fmi2Component c)
{
    ANSWER(c);
    return core_reset(c);
}

fmi2Status fmi2Terminate(fmi2Component c) { return core_terminate(c, __func__); }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined,
                               fmi2Real tolerance, fmi2Real start, fmi2Boolean stop_defined,
                               fmi2Real stop)
{
    ANSWER(c);
    (void)tolerance_defined, (void)tolerance;
    return core_set_up(c, __func__, start, stop_defined, stop);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    ANSWER(c);
    return core_enter_initialization(c, __func__);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    ANSWER(c);
    return core_exit_initialization(c, __func__);
}

/* ---- variables ----------------------------------------------------------------------------- */

#define NUMBERS(Type, types)                                                                       \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             fmi2##Type value[])                                                   \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return get_numbers(c, __func__, vr, nvr, types, sizeof *value, value, nvr);                \
    }                                                                                              \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             const fmi2##Type value[])                                             \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return set_numbers(c, __func__, vr, nvr, types, sizeof *value, value, nvr);                \
    }

NUMBERS(Real, FLOAT64)
NUMBERS(Integer, INT32 | ENUMERATION)
NUMBERS(Boolean, BOOLEAN)

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         fmi2String value[])
{
    return get_texts(c, __func__, vr, nvr, value, nvr);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         const fmi2String value[])
{
    return set_texts(c, __func__, vr, nvr, value, nvr);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[],
                                        size_t n_unknown, const fmi2ValueReference known[],
                                        size_t n_known, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    ANSWER(c);
    return directional(c, __func__, unknown, n_unknown, known, n_known, seed, sensitivity);
}

/* ---- FMU states ---------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *saved)
{
    return core_get_state(c, __func__, saved);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate saved)
{
    return core_set_state(c, __func__, saved);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *saved)
{
    (void)c;
    free(*saved);
    *saved = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate saved, size_t *size)
{
    (void)c, (void)saved;
    *size = sizeof(State);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate saved, fmi2Byte bytes[],
                                 size_t size)
{
    return core_serialize(c, __func__, saved, bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *saved)
{
    return core_deserialize(c, __func__, bytes, size, saved);
}

/* ---- model exchange ------------------------------------------------------------------------ */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    ANSWER(c);
    return core_enter_event_mode(c, __func__, MODEL_EXCHANGE);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    ANSWER(c);
    Event event;
    const int status = core_update(c, __func__, &event);
    info->newDiscreteStatesNeeded = event.again;
    info->terminateSimulation = event.terminate;
    info->nominalsOfContinuousStatesChanged = event.nominals_changed;
    info->valuesOfContinuousStatesChanged = event.states_changed;
    info->nextEventTimeDefined = isfinite(event.next_time);
    info->nextEventTime = isfinite(event.next_time) ? event.next_time : 0.0;
    return status;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    ANSWER(c);
    return core_enter_continuous_time(c, __func__);
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set_state_prior,
                                       fmi2Boolean *enter_event_mode, fmi2Boolean *terminate)
{
    ANSWER(c);
    bool enter = false;
    (void)no_set_state_prior;
    const int status = core_completed_step(c, __func__, &enter);
    *enter_event_mode = enter;
    *terminate = status == OK && model_step_ends(c);
    return status;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    ANSWER(c);
    return core_set_time(c, __func__, time);
}

#define VECTOR(Name, function, Const)                                                              \
    fmi2Status fmi2##Name(fmi2Component c, Const fmi2Real x[], size_t n)                           \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return function(c, __func__, x, n);                                                        \
    }

VECTOR(SetContinuousStates, core_set_states, const)
VECTOR(GetContinuousStates, core_get_states, )
VECTOR(GetDerivatives, core_get_derivatives, )
VECTOR(GetNominalsOfContinuousStates, core_get_nominals, )
VECTOR(GetEventIndicators, core_get_indicators, )

/* ---- co-simulation ------------------------------------------------------------------------- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    return set_slopes(c, __func__, vr, nvr, order, value);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return nvr == 0 ? OK : error(c, "%s: not provided", __func__);
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real point, fmi2Real step,
                      fmi2Boolean no_set_state_prior)
{
    ANSWER(c);
    (void)no_set_state_prior;
    return core_do_step(c, __func__, point, step);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return error(c, "%s: steps are never pending", __func__);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    *value = ((Model *)c)->state.v.time;
    return kind == fmi2LastSuccessfulTime ? fmi2OK : fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    *value = ((Model *)c)->state.ended;
    return kind == fmi2Terminated ? fmi2OK : fmi2Discard;
}

#define NO_STATUS(Name, Type)                                                                      \
    fmi2Status fmi2Get##Name(fmi2Component c, const fmi2StatusKind kind, Type *value)              \
    {                                                                                              \
        (void)c, (void)kind, (void)value;                                                          \
        return fmi2Discard;                                                                        \
    }

NO_STATUS(Status, fmi2Status)
NO_STATUS(IntegerStatus, fmi2Integer)
NO_STATUS(StringStatus, fmi2String)
