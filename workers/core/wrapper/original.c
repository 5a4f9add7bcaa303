/* The original FMU: its library, loaded from resources/original, and one instance of it. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include "system.h"
#include "wrapper.h"

/* Which of them an original must have. */
enum { ALL, EXCHANGE, SIMULATION, NO_ONE };
static const struct {
    size_t at;
    int who;
    const char *name2, *name3; /* without the prefix; NULL: that version has none */
} functions[] = {
#define IN_CORE(field, who, name2, name3) {offsetof(Original, f.field), who, name2, name3},
#define BESIDE(field, who, name2, name3) {offsetof(Original, field), who, name2, name3},
    BESIDE(free_instance, ALL, "FreeInstance", "FreeInstance")
    IN_CORE(reset, ALL, "Reset", "Reset")
    IN_CORE(setup_experiment, ALL, "SetupExperiment", NULL)
    IN_CORE(enter_configuration_mode, NO_ONE, NULL, "EnterConfigurationMode")
    IN_CORE(exit_configuration_mode, NO_ONE, NULL, "ExitConfigurationMode")
    IN_CORE(enter_initialization_mode, ALL, "EnterInitializationMode", "EnterInitializationMode")
    IN_CORE(exit_initialization_mode, ALL, "ExitInitializationMode", "ExitInitializationMode")
    IN_CORE(set_string, NO_ONE, "SetString", "SetString")
    IN_CORE(set_time, EXCHANGE, "SetTime", "SetTime")
    IN_CORE(set_continuous_states, NO_ONE, "SetContinuousStates", "SetContinuousStates")
    IN_CORE(get_continuous_states, NO_ONE, "GetContinuousStates", "GetContinuousStates")
    IN_CORE(get_nominals, NO_ONE, "GetNominalsOfContinuousStates", "GetNominalsOfContinuousStates")
    IN_CORE(get_derivatives, NO_ONE, "GetDerivatives", "GetContinuousStateDerivatives")
    IN_CORE(get_event_indicators, NO_ONE, "GetEventIndicators", "GetEventIndicators")
    IN_CORE(enter_event_mode, EXCHANGE, "EnterEventMode", "EnterEventMode")
    IN_CORE(update_discrete_states, EXCHANGE, "NewDiscreteStates", "UpdateDiscreteStates")
    IN_CORE(enter_continuous_time_mode, EXCHANGE, "EnterContinuousTimeMode",
            "EnterContinuousTimeMode")
    IN_CORE(completed_integrator_step, NO_ONE, "CompletedIntegratorStep",
            "CompletedIntegratorStep")
    IN_CORE(do_step, SIMULATION, "DoStep", "DoStep")
    IN_CORE(set_real_input_derivatives, NO_ONE, "SetRealInputDerivatives", NULL)
    IN_CORE(get_directional_derivative, NO_ONE, "GetDirectionalDerivative",
            "GetDirectionalDerivative")
    BESIDE(terminate, ALL, "Terminate", "Terminate")
    BESIDE(set_debug_logging, NO_ONE, "SetDebugLogging", "SetDebugLogging")
    BESIDE(get_string, NO_ONE, "GetString", "GetString")
    BESIDE(get_state, NO_ONE, "GetFMUstate", "GetFMUState")
    BESIDE(set_state, NO_ONE, "SetFMUstate", "SetFMUState")
    BESIDE(free_state, NO_ONE, "FreeFMUstate", "FreeFMUState")
    BESIDE(state_size, NO_ONE, "SerializedFMUstateSize", "SerializedFMUStateSize")
    BESIDE(serialise, NO_ONE, "SerializeFMUstate", "SerializeFMUState")
    BESIDE(deserialise, NO_ONE, "DeSerializeFMUstate", "DeserializeFMUState")
    BESIDE(get_real_status, NO_ONE, "GetRealStatus", NULL)
    BESIDE(get_boolean_status, NO_ONE, "GetBooleanStatus", NULL)};

/* In the order of `Fmu.get`. */
static const char *const types[][2] = {
    {"Real", "Float64"}, {NULL, "Float32"}, {NULL, "Int8"}, {NULL, "UInt8"}, {NULL, "Int16"},
    {NULL, "UInt16"}, {"Integer", "Int32"}, {NULL, "UInt32"}, {NULL, "Int64"}, {NULL, "UInt64"},
    {"Boolean", "Boolean"}};

/* Fill in a function, if the library has it. */
static int find(const Instance *c, Function *to, const char *prefix, const char *name,
                char *whole) {
    snprintf(whole, 64, "fmi%d%s%s", c->facts->version, prefix, name);
    void *found = look_up(c->original.library, whole);
    memcpy(to, &found, sizeof found);
    return found != NULL;
}

/* Fill in all of them. Returns whether those are there that must be; else `name` is one that is
 * not. */
static int bind(Instance *c, char *name) {
    const Facts *f = c->facts;
    const int is_3 = f->version == 3;
    Original *o = &c->original;
    for (size_t i = 0; i < sizeof functions / sizeof *functions; i++) {
        const char *called = is_3 ? functions[i].name3 : functions[i].name2;
        const int who = functions[i].who;
        const int must = who == ALL || who == (f->exchange ? EXCHANGE : SIMULATION);
        if (called == NULL) continue;
        if (!find(c, (Function *)((char *)o + functions[i].at), "", called, name) && must) return 0;
    }
    for (size_t i = 0; i < N_TYPES; i++)
        if (types[i][is_3] != NULL
            && ((!find(c, &o->f.get[i], "Get", types[i][is_3], name) && i == 0)
                || (!find(c, &o->f.set[i], "Set", types[i][is_3], name) && i == 0)))
            return 0;
    if (f->exchange && f->n_states > 0 && o->f.get_derivatives == NULL)
        return strcpy(name, "fmi2GetDerivatives"), 0;
    const char *made = !is_3 ? "" : f->exchange ? "ModelExchange" : "CoSimulation";
    return find(c, &o->instantiate, "Instantiate", made, name);
}

/* What the original says, with a prefix. */
static void pass_2(void *environment, fmi2String name, fmi2Status status, fmi2String category,
                   fmi2String message, ...) {
    char text[2048] = "original FMU: ";
    const size_t prefix = strlen(text);
    va_list arguments;
    (void)name;
    va_start(arguments, message);
    vsnprintf(text + prefix, sizeof text - prefix, message == NULL ? "" : message, arguments);
    va_end(arguments);
    say(environment, status, category, text);
}

static void pass_3(void *environment, int status, const char *category, const char *message) {
    pass_2(environment, "", status, category, "%s", message == NULL ? "" : message);
}

typedef void Logger3(void *, int, const char *, const char *);
typedef void *Exchange3(const char *, const char *, const char *, uint8_t, uint8_t, void *,
                        Logger3 *);
typedef void *Simulation3(const char *, const char *, const char *, uint8_t, uint8_t, uint8_t,
                          uint8_t, const uint32_t *, size_t, void *, Logger3 *, Function);

/* FMI 2.0 wants a URI of the resources, and 3.0 a path. */
static void *instantiate(Instance *c, const char *resources, const char *folder, char *path,
                         size_t size, fmi2Boolean visible, fmi2Boolean logging) {
    const Function f = c->original.instantiate;
    const char *guid = c->table.original_guid;
    const int sees = visible != 0, logs = logging != 0;
    c->inner = c->callbacks;
    c->inner.logger = pass_2, c->inner.stepFinished = NULL, c->inner.componentEnvironment = c;
    if (c->facts->version == 2) {
        snprintf(path, size, "%s/original/resources", resources);
        return ((fmi2InstantiateTYPE *)f)(c->name,
                                          c->facts->exchange ? fmi2ModelExchange : fmi2CoSimulation,
                                          guid, path, &c->inner, visible, logging);
    }
    snprintf(path, size, "%s/original/resources/", folder);
    if (c->facts->exchange)
        return ((Exchange3 *)f)(c->name, guid, path, (uint8_t)sees, (uint8_t)logs, c, pass_3);
    return ((Simulation3 *)f)(c->name, guid, path, (uint8_t)sees, (uint8_t)logs, 0, 0, NULL, 0, c,
                              pass_3, NULL);
}

int original_load(Instance *c, const char *resources, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length) {
    Original *o = &c->original;
    const char *identifier = c->table.identifier;
    const size_t size = strlen(resources) + 512;
    char *folder = path_of(resources), *path = malloc(size), name[64] = "";
    if (folder == NULL || path == NULL) {
        snprintf(why, length, "there is no memory left");
    } else {
        snprintf(path, size, "%s/original/binaries/%s%d/%s%s", folder, SYSTEM_2,
                 (int)(8 * sizeof(void *)), identifier, SUFFIX);
        if (c->facts->version == 3)
            snprintf(path, size, "%s/original/binaries/" MACHINE "-" SYSTEM_3 "/%s%s", folder,
                     identifier, SUFFIX);
        o->library = open_library(path);
        if (o->library == NULL)
            snprintf(why, length, "the original FMU's library %s cannot be loaded: %s", path,
                     why_not_loaded());
        else if (!bind(c, name))
            snprintf(why, length, "the original FMU must have the function %s but has not", name);
        else
            o->f.handle = instantiate(c, resources, folder, path, size, visible, logging);
        if (o->library != NULL && o->f.handle == NULL && why[0] == '\0')
            snprintf(why, length, "the original FMU could not be instantiated");
    }
    free(folder);
    free(path);
    return why[0] == '\0' ? 0 : -1;
}

void original_free(Original *o) {
    if (o->f.handle != NULL) ((void (*)(void *))o->free_instance)(o->f.handle);
    if (o->library != NULL) close_library(o->library);
    o->f.handle = o->library = NULL;
}
