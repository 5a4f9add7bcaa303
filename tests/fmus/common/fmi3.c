/* The FMI 3.0 API over core.c: no clocks, no intermediate updates, no early return. */
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "fmi3Functions.h"

void log_error(const Model *m, const char *message)
{
    fmi3LogMessageCallback log = NULL;
    memcpy(&log, &m->callbacks, sizeof log); /* C99 does not cast data to functions */
    if (log != NULL)
        log(m->environment, fmi3Error, "logStatusError", message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n,
                               const fmi3String categories[])
{
    (void)c, (void)on, (void)n, (void)categories; /* there are only errors, always logged */
    return fmi3OK;
}

static fmi3Instance instantiate(fmi3String name, fmi3String token, fmi3String resources,
                                bool co_simulation, bool logging_on,
                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    const void *callbacks;
    memcpy(&callbacks, &log, sizeof callbacks);
    Model *m = core_new(name, token, resources, co_simulation, callbacks, environment);
    if (m != NULL)
        m->logging_on = logging_on;
    return m;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging_on,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)visible;
    return instantiate(name, token, resources, false, logging_on, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging_on, fmi3Boolean event_mode_used, fmi3Boolean early_return_allowed,
    const fmi3ValueReference intermediate[], size_t n_intermediate,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback intermediate_update)
{
    (void)visible, (void)early_return_allowed;
    (void)intermediate, (void)intermediate_update;
    Model *m = instantiate(name, token, resources, true, logging_on, environment, log);
    if (m == NULL || (!event_mode_used && n_intermediate == 0))
        return m;
    error(m, "%s: event mode and intermediate variables are not offered", __func__);
    core_free(m);
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging_on, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3ClockUpdateCallback clock_update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging_on;
    (void)environment, (void)log, (void)clock_update, (void)lock, (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) { core_free(c); }
fmi3Status fmi3Reset(fmi3Instance c)
{
    ANSWER(c);
    return core_reset(c);
}

fmi3Status fmi3Terminate(fmi3Instance c) { return core_terminate(c, __func__); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stop_defined, fmi3Float64 stop)
{
    ANSWER(c);
    (void)tolerance_defined, (void)tolerance;
    if (core_set_up(c, __func__, start, stop_defined, stop) != OK)
        return fmi3Error;
    return core_enter_initialization(c, __func__);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    ANSWER(c);
    return core_exit_initialization(c, __func__);
}

static fmi3Status configure(Model *m, const char *function, unsigned from, unsigned to)
{
    if (require(m, from, function) != OK)
        return fmi3Error;
    m->state.phase = to;
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    if (!STRUCTURAL)
        return error(c, "%s: there are no structural parameters", __func__);
    return configure(c, __func__, INSTANTIATED, CONFIGURATION);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return configure(c, __func__, CONFIGURATION, INSTANTIATED);
}

/* ---- variables ----------------------------------------------------------------------------- */

#define NUMBERS(Type, types)                                                                       \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,            \
                             fmi3##Type values[], size_t n)                                        \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return get_numbers(c, __func__, vr, nvr, types, sizeof *values, values, n);                \
    }                                                                                              \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,            \
                             const fmi3##Type values[], size_t n)                                  \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return set_numbers(c, __func__, vr, nvr, types, sizeof *values, values, n);                \
    }

NUMBERS(Float64, FLOAT64)
NUMBERS(Float32, FLOAT32)
NUMBERS(Int8, INT8)
NUMBERS(Int16, INT16)
NUMBERS(Int32, INT32)
NUMBERS(Int64, INT64 | ENUMERATION)
NUMBERS(UInt8, UINT8)
NUMBERS(UInt16, UINT16)
NUMBERS(UInt32, UINT32)
NUMBERS(UInt64, UINT64)
NUMBERS(Boolean, BOOLEAN)

fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                         fmi3String values[], size_t n)
{
    return get_texts(c, __func__, vr, nvr, values, n);
}

fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                         const fmi3String values[], size_t n)
{
    return set_texts(c, __func__, vr, nvr, values, n);
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, size_t sizes[],
                         fmi3Binary values[], size_t n)
{
    size_t count;
    for (size_t i = 0; i < nvr && i < n; i++) { /* there are only scalar ones */
        const Binary *source = readable(c, __func__, vr[i], BINARY, &count);
        if (source == NULL)
            return fmi3Error;
        sizes[i] = source->size;
        values[i] = source->bytes;
    }
    return check_size(c, n, nvr, __func__);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                         const size_t sizes[], const fmi3Binary values[], size_t n)
{
    size_t count;
    for (size_t i = 0; i < nvr && i < n; i++) {
        Binary *target = writable(c, __func__, vr[i], BINARY, &count);
        if (target == NULL)
            return fmi3Error;
        if (sizes[i] > TEXT_SIZE)
            return error(c, "%s: at most %d bytes are possible", __func__, TEXT_SIZE);
        target->size = sizes[i];
        memcpy(target->bytes, values[i], sizes[i]);
    }
    return check_size(c, n, nvr, __func__);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t n_unknowns, const fmi3ValueReference knowns[],
                                        size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    ANSWER(c);
    if (check_size(c, n_seed, n_knowns, __func__) != OK ||
        check_size(c, n_sensitivity, n_unknowns, __func__) != OK)
        return fmi3Error;
    return directional(c, __func__, unknowns, n_unknowns, knowns, n_knowns, seed, sensitivity);
}

/* ---- FMU states ---------------------------------------------------------------------------- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *saved)
{
    return core_get_state(c, __func__, saved);
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState saved)
{
    return core_set_state(c, __func__, saved);
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *saved)
{
    (void)c;
    free(*saved);
    *saved = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState saved, size_t *size)
{
    (void)c, (void)saved;
    *size = sizeof(State);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState saved, fmi3Byte bytes[], size_t size)
{
    return core_serialize(c, __func__, saved, bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *saved)
{
    return core_deserialize(c, __func__, bytes, size, saved);
}

/* ---- model exchange ------------------------------------------------------------------------ */

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    ANSWER(c);
    return core_enter_event_mode(c, __func__, CONTINUOUS_TIME);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *next_time_defined, fmi3Float64 *next_time)
{
    ANSWER(c);
    Event event;
    const int status = core_update(c, __func__, &event);
    *again = event.again;
    *terminate = event.terminate;
    *nominals_changed = event.nominals_changed;
    *states_changed = event.states_changed;
    *next_time_defined = isfinite(event.next_time);
    *next_time = isfinite(event.next_time) ? event.next_time : 0.0;
    return status;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return error(c, "%s: not provided", __func__);
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    ANSWER(c);
    return core_enter_continuous_time(c, __func__);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state_prior,
                                       fmi3Boolean *enter_event_mode, fmi3Boolean *terminate)
{
    ANSWER(c);
    (void)no_set_state_prior;
    *enter_event_mode = false;
    const int status = core_completed_step(c, __func__, enter_event_mode);
    *terminate = status == OK && model_step_ends(c);
    return status;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    ANSWER(c);
    return core_set_time(c, __func__, time);
}

#define VECTOR(Name, function, Const)                                                              \
    fmi3Status fmi3##Name(fmi3Instance c, Const fmi3Float64 x[], size_t n)                         \
    {                                                                                              \
        ANSWER(c);                                                                                 \
        return function(c, __func__, x, n);                                                        \
    }

VECTOR(SetContinuousStates, core_set_states, const)
VECTOR(GetContinuousStates, core_get_states, )
VECTOR(GetContinuousStateDerivatives, core_get_derivatives, )
VECTOR(GetNominalsOfContinuousStates, core_get_nominals, )
VECTOR(GetEventIndicators, core_get_indicators, )

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    (void)c;
    *n = N_INDICATORS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    *n = count_states(c);
    return fmi3OK;
}

/* ---- co-simulation ------------------------------------------------------------------------- */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 point, fmi3Float64 step,
                      fmi3Boolean no_set_state_prior, fmi3Boolean *event_handling_needed,
                      fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_successful_time)
{
    ANSWER(c);
    Model *m = c;
    (void)no_set_state_prior;
    const int status = core_do_step(m, __func__, point, step);
    *event_handling_needed = false;
    *early_return = false;
    *terminate = m->state.ended;
    *last_successful_time = M(time);
    return status == DISCARD ? OK : status; /* version 3 says it with `terminate` alone */
}

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return error(c, "%s: co-simulation has no event mode", __func__);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t n)
{
    (void)vr, (void)orders, (void)values;
    return nvr + n == 0 ? OK : error(c, "%s: not provided", __func__);
}

/* ---- what these models do not have --------------------------------------------------------- */

#define NOT_PROVIDED(Name, ...)                                                                    \
    fmi3Status fmi3##Name(fmi3Instance c, __VA_ARGS__)                                             \
    {                                                                                              \
        return error(c, "%s: not provided", __func__);                                             \
    }
#define REFERENCES const fmi3ValueReference vr[], size_t nvr

#pragma GCC diagnostic ignored "-Wunused-parameter"
NOT_PROVIDED(GetClock, REFERENCES, fmi3Clock values[])
NOT_PROVIDED(SetClock, REFERENCES, const fmi3Clock values[])
NOT_PROVIDED(GetNumberOfVariableDependencies, fmi3ValueReference vr, size_t *n)
NOT_PROVIDED(GetVariableDependencies, fmi3ValueReference dependent, size_t element[],
             fmi3ValueReference independents[], size_t elements[], fmi3DependencyKind kinds[],
             size_t n)
NOT_PROVIDED(GetAdjointDerivative, REFERENCES, const fmi3ValueReference knowns[], size_t n_knowns,
             const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[], size_t n)
NOT_PROVIDED(GetIntervalDecimal, REFERENCES, fmi3Float64 intervals[],
             fmi3IntervalQualifier qualifiers[])
NOT_PROVIDED(GetIntervalFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
             fmi3IntervalQualifier qualifiers[])
NOT_PROVIDED(GetShiftDecimal, REFERENCES, fmi3Float64 shifts[])
NOT_PROVIDED(GetShiftFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
NOT_PROVIDED(SetIntervalDecimal, REFERENCES, const fmi3Float64 intervals[])
NOT_PROVIDED(SetIntervalFraction, REFERENCES, const fmi3UInt64 counters[],
             const fmi3UInt64 resolutions[])
NOT_PROVIDED(SetShiftDecimal, REFERENCES, const fmi3Float64 shifts[])
NOT_PROVIDED(SetShiftFraction, REFERENCES, const fmi3UInt64 counters[],
             const fmi3UInt64 resolutions[])
NOT_PROVIDED(ActivateModelPartition, fmi3ValueReference clock, fmi3Float64 time)
