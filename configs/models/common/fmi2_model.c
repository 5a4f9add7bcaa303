/*
 * The whole FMI 2.0 API, model exchange and co-simulation, for a small model of ordinary
 * differential equations. The generated model_variables.h says which variables there are,
 * model_equations() how they are computed. Nothing is global: instances are independent.
 *
 * Value references index one array, laid out as
 *     time | parameters | inputs | states | derivatives | outputs
 * so that states and derivatives are contiguous and everything computed is at the end.
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "fmi2_model.h"

static const char *const NAME[N_VARIABLES] = NAMES;
static const double START[N_VARIABLES] = STARTS;
static const double NOMINAL[N_STATES] = NOMINALS;
static const unsigned SETTABLE[N_VARIABLES] = SETTABLE_PHASES;

/* ---- logging ---------------------------------------------------------------------------- */

static void log_error(const fmi2CallbackFunctions *callbacks, const char *instance,
                      const char *message)
{
    if (callbacks && callbacks->logger)
        callbacks->logger(callbacks->componentEnvironment, instance, fmi2Error,
                          "logStatusError", message);
}

fmi2Status model_error(const Model *m, const char *format, ...)
{
    char message[256];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    log_error(m->callbacks, m->instance_name, message);
    return fmi2Error;
}

/* ---- values ----------------------------------------------------------------------------- */

static double *states(Model *m) { return m->state.value + FIRST_STATE; }

static double *derivatives(Model *m) { return m->state.value + FIRST_DERIVATIVE; }

static State initial_state(void)
{
    State state;
    memset(&state, 0, sizeof state); /* padding too: serialized states are compared as bytes */
    memcpy(state.value, START, sizeof START);
    state.phase = INSTANTIATED;
    state.stale = true;
    return state;
}

static fmi2Status evaluate(Model *m)
{
    if (model_equations(m) != fmi2OK)
        return fmi2Error;
    for (int i = FIRST_DERIVATIVE; i < N_VARIABLES; i++)
        if (!isfinite(m->state.value[i]))
            return model_error(m, "%s is not finite at time %g", NAME[i], M(time));
    m->state.stale = false;
    return fmi2OK;
}

static fmi2Status refresh(Model *m) { return m->state.stale ? evaluate(m) : fmi2OK; }

static fmi2Status require(const Model *m, unsigned phases, const char *function)
{
    if (m->state.phase & phases)
        return fmi2OK;
    return model_error(m, "%s: not allowed at this point of the simulation", function);
}

static fmi2Status move(Model *m, unsigned from, unsigned to, const char *function)
{
    if (require(m, from, function) != fmi2OK)
        return fmi2Error;
    m->state.phase = to;
    return fmi2OK;
}

static fmi2Status check_size(const Model *m, size_t size, size_t expected, const char *function)
{
    if (size == expected)
        return fmi2OK;
    return model_error(m, "%s: %lu values expected, got %lu", function,
                       (unsigned long)expected, (unsigned long)size);
}

static fmi2Status no_variable(const Model *m, const char *function, fmi2ValueReference vr)
{
    return model_error(m, "%s: no variable has the value reference %u", function, vr);
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       fmi2Real value[])
{
    Model *m = c;
    for (size_t i = 0; i < nvr; i++) {
        if (vr[i] >= N_VARIABLES)
            return no_variable(m, "fmi2GetReal", vr[i]);
        if (vr[i] >= FIRST_DERIVATIVE && refresh(m) != fmi2OK)
            return fmi2Error;
        value[i] = m->state.value[vr[i]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[])
{
    Model *m = c;
    for (size_t i = 0; i < nvr; i++) {
        if (vr[i] >= N_VARIABLES)
            return no_variable(m, "fmi2SetReal", vr[i]);
        if (!(SETTABLE[vr[i]] & m->state.phase))
            return model_error(m, "fmi2SetReal: %s cannot be set %s", NAME[vr[i]],
                               SETTABLE[vr[i]] ? "any more" : "at all");
        m->state.value[vr[i]] = value[i];
        m->state.slope[vr[i]] = 0.0;
        m->state.stale = true;
    }
    return fmi2OK;
}

/* Models have real variables only: asking for none of another type is the sole legal call. */
#define NO_VARIABLES_OF_TYPE(Type)                                                             \
    static fmi2Status no_##Type(const Model *m, size_t nvr)                                    \
    {                                                                                          \
        return nvr == 0 ? fmi2OK : model_error(m, "there are no variables of type " #Type);    \
    }                                                                                          \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,       \
                             fmi2##Type value[])                                               \
    {                                                                                          \
        (void)vr, (void)value;                                                                 \
        return no_##Type(c, nvr);                                                              \
    }                                                                                          \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,       \
                             const fmi2##Type value[])                                         \
    {                                                                                          \
        (void)vr, (void)value;                                                                 \
        return no_##Type(c, nvr);                                                              \
    }

NO_VARIABLES_OF_TYPE(Integer)
NO_VARIABLES_OF_TYPE(Boolean)
NO_VARIABLES_OF_TYPE(String)

/* ---- life of an instance ---------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n,
                               const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories; /* there are only errors, always logged */
    return fmi2OK;
}

static char *copy_of(const char *text)
{
    char *copy = malloc(strlen(text) + 1);
    return copy ? strcpy(copy, text) : NULL;
}

fmi2Component fmi2Instantiate(fmi2String instance_name, fmi2Type type, fmi2String guid,
                              fmi2String resources, const fmi2CallbackFunctions *callbacks,
                              fmi2Boolean visible, fmi2Boolean logging_on)
{
    (void)resources, (void)visible, (void)logging_on;
    const char *name = instance_name ? instance_name : MODEL_NAME;
    if (!guid || strcmp(guid, MODEL_GUID) != 0) {
        log_error(callbacks, name, "fmi2Instantiate: the GUID differs from " MODEL_GUID);
        return NULL;
    }
    Model *m = calloc(1, sizeof *m);
    if (!m)
        return NULL;
    m->state = initial_state();
    m->type = type;
    m->callbacks = callbacks;
    m->instance_name = copy_of(name);
    return m;
}

void fmi2FreeInstance(fmi2Component c)
{
    Model *m = c;
    if (!m)
        return;
    free(m->instance_name);
    free(m);
}

fmi2Status fmi2Reset(fmi2Component c)
{
    ((Model *)c)->state = initial_state();
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined,
                               fmi2Real tolerance, fmi2Real start_time,
                               fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    Model *m = c;
    (void)tolerance_defined, (void)tolerance, (void)stop_time_defined, (void)stop_time;
    if (require(m, INSTANTIATED, "fmi2SetupExperiment") != fmi2OK)
        return fmi2Error;
    M(time) = start_time;
    m->state.stale = true;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    return move(c, INSTANTIATED, INITIALIZATION, "fmi2EnterInitializationMode");
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Model *m = c;
    if (require(m, INITIALIZATION, "fmi2ExitInitializationMode") != fmi2OK)
        return fmi2Error;
    if (refresh(m) != fmi2OK) /* bad parameters are reported here, not in the first step */
        return fmi2Error;
    m->state.phase = m->type == fmi2CoSimulation ? STEPPING : EVENT_MODE;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    ((Model *)c)->state.phase = TERMINATED;
    return fmi2OK;
}

/* ---- FMU states ------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *saved)
{
    Model *m = c;
    if (!*saved)
        *saved = malloc(sizeof(State));
    if (!*saved)
        return model_error(m, "fmi2GetFMUstate: out of memory");
    memcpy(*saved, &m->state, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate saved)
{
    Model *m = c;
    if (!saved)
        return model_error(m, "fmi2SetFMUstate: no state given");
    memcpy(&m->state, saved, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *saved)
{
    (void)c;
    if (saved) {
        free(*saved);
        *saved = NULL;
    }
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
    if (check_size(c, size, sizeof(State), "fmi2SerializeFMUstate") != fmi2OK)
        return fmi2Error;
    memcpy(bytes, saved, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *saved)
{
    if (check_size(c, size, sizeof(State), "fmi2DeSerializeFMUstate") != fmi2OK)
        return fmi2Error;
    if (!*saved)
        *saved = malloc(sizeof(State));
    if (!*saved)
        return model_error(c, "fmi2DeSerializeFMUstate: out of memory");
    memcpy(*saved, bytes, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[],
                                        size_t n_unknown, const fmi2ValueReference known[],
                                        size_t n_known, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    (void)unknown, (void)n_unknown, (void)known, (void)n_known, (void)seed, (void)sensitivity;
    return model_error(c, "fmi2GetDirectionalDerivative: not provided");
}

/* ---- model exchange --------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    return move(c, MODEL_EXCHANGE, EVENT_MODE, "fmi2EnterEventMode");
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    memset(info, 0, sizeof *info); /* every flag false: nothing here is discrete */
    return require(c, EVENT_MODE, "fmi2NewDiscreteStates");
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    return move(c, EVENT_MODE, CONTINUOUS_TIME, "fmi2EnterContinuousTimeMode");
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set_state_prior,
                                       fmi2Boolean *enter_event_mode, fmi2Boolean *terminate)
{
    (void)no_set_state_prior;
    *enter_event_mode = fmi2False;
    *terminate = fmi2False;
    return require(c, CONTINUOUS_TIME, "fmi2CompletedIntegratorStep");
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Model *m = c;
    if (require(m, MODEL_EXCHANGE, "fmi2SetTime") != fmi2OK)
        return fmi2Error;
    M(time) = time;
    m->state.stale = true;
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    Model *m = c;
    if (require(m, MODEL_EXCHANGE, "fmi2SetContinuousStates") != fmi2OK ||
        check_size(m, nx, N_STATES, "fmi2SetContinuousStates") != fmi2OK)
        return fmi2Error;
    memcpy(states(m), x, N_STATES * sizeof *x);
    m->state.stale = true;
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    if (check_size(c, nx, N_STATES, "fmi2GetContinuousStates") != fmi2OK)
        return fmi2Error;
    memcpy(x, states(c), N_STATES * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t nx)
{
    if (check_size(c, nx, N_STATES, "fmi2GetDerivatives") != fmi2OK || refresh(c) != fmi2OK)
        return fmi2Error;
    memcpy(dx, derivatives(c), N_STATES * sizeof *dx);
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    if (check_size(c, nx, N_STATES, "fmi2GetNominalsOfContinuousStates") != fmi2OK)
        return fmi2Error;
    memcpy(x, NOMINAL, sizeof NOMINAL);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n)
{
    (void)indicators;
    return check_size(c, n, 0, "fmi2GetEventIndicators");
}

/* ---- co-simulation ---------------------------------------------------------------------- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[],
                                       size_t nvr, const fmi2Integer order[],
                                       const fmi2Real value[])
{
    Model *m = c;
    for (size_t i = 0; i < nvr; i++) {
        if (vr[i] < FIRST_INPUT || vr[i] >= FIRST_STATE)
            return model_error(m, "fmi2SetRealInputDerivatives: %u is not an input", vr[i]);
        if (order[i] != 1)
            return model_error(m, "fmi2SetRealInputDerivatives: order must be 1, got %d",
                               order[i]);
        m->state.slope[vr[i]] = value[i];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[],
                                        size_t nvr, const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return nvr == 0 ? fmi2OK : model_error(c, "fmi2GetRealOutputDerivatives: not provided");
}

/* Moves time and the inputs, which run linearly within a step, `offset` after its start. */
static void move_in_step(Model *m, const State *start, double offset)
{
    M(time) = start->value[V_time] + offset;
    for (int i = FIRST_INPUT; i < FIRST_STATE; i++)
        m->state.value[i] = start->value[i] + start->slope[i] * offset;
}

/* One classic Runge-Kutta step of size h that begins `offset` after the start. */
static fmi2Status runge_kutta(Model *m, const State *start, double offset, double h)
{
    static const double NODE[] = {0.0, 0.5, 0.5, 1.0};
    static const double WEIGHT[] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    double x[N_STATES], k[N_STATES] = {0.0}, mean[N_STATES] = {0.0};
    memcpy(x, states(m), sizeof x);
    for (int stage = 0; stage < 4; stage++) {
        move_in_step(m, start, offset + NODE[stage] * h);
        for (int i = 0; i < N_STATES; i++)
            states(m)[i] = x[i] + NODE[stage] * h * k[i];
        if (evaluate(m) != fmi2OK)
            return fmi2Error;
        for (int i = 0; i < N_STATES; i++) {
            k[i] = derivatives(m)[i];
            mean[i] += WEIGHT[stage] * k[i];
        }
    }
    for (int i = 0; i < N_STATES; i++)
        states(m)[i] = x[i] + h * mean[i];
    return fmi2OK;
}

/* Integrates over a whole communication step and leaves the inputs as they were set. */
static fmi2Status integrate(Model *m, const State *start, double step)
{
    /* Rounding in step / MAX_STEP must not cost a substep more. */
    const double n = fmax(1.0, ceil(step / MAX_STEP * (1.0 - 1e-9)));
    const double h = step / n;
    for (double i = 0.0; i < n; i++)
        if (runge_kutta(m, start, i * h, h) != fmi2OK)
            return fmi2Error;
    memcpy(m->state.value + FIRST_INPUT, start->value + FIRST_INPUT,
           (FIRST_STATE - FIRST_INPUT) * sizeof(double));
    memset(m->state.slope, 0, sizeof m->state.slope);
    M(time) = start->value[V_time] + step;
    return evaluate(m);
}

static fmi2Status check_step(const Model *m, double point, double step)
{
    if (require(m, STEPPING, "fmi2DoStep") != fmi2OK)
        return fmi2Error;
    if (!isfinite(step) || step < 0.0)
        return model_error(m, "fmi2DoStep: step size must not be negative, got %g", step);
    if (!(fabs(point - M(time)) <= 1e-8 * (1.0 + fabs(M(time)))))
        return model_error(m, "fmi2DoStep: step begins at %g, the model is at %g", point, M(time));
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real point, fmi2Real step,
                      fmi2Boolean no_set_state_prior)
{
    Model *m = c;
    (void)no_set_state_prior;
    if (check_step(m, point, step) != fmi2OK)
        return fmi2Error;
    M(time) = point; /* the master's clock rules: differences in rounding must not add up */
    const State start = m->state;
    if (integrate(m, &start, step) == fmi2OK)
        return fmi2OK;
    m->state = start;
    return fmi2Error;
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return model_error(c, "fmi2CancelStep: steps are never pending");
}

/* Every step is finished when fmi2DoStep returns, so there is no status to ask for. */
#define NO_STATUS(Name, Type)                                                                  \
    fmi2Status fmi2Get##Name(fmi2Component c, const fmi2StatusKind kind, Type *value)          \
    {                                                                                          \
        (void)c, (void)kind, (void)value;                                                      \
        return fmi2Discard;                                                                    \
    }

NO_STATUS(Status, fmi2Status)
NO_STATUS(RealStatus, fmi2Real)
NO_STATUS(IntegerStatus, fmi2Integer)
NO_STATUS(BooleanStatus, fmi2Boolean)
NO_STATUS(StringStatus, fmi2String)
