/* What a model sees of the scaffold: its variables, M(name), and a way to report an error. */
#ifndef FMI2_MODEL_H
#define FMI2_MODEL_H

#include <stdbool.h>

#include "fmi2FunctionTypes.h"
#include "model_variables.h"

/* Phases of an instance, one bit each, so that a set of phases is one mask. */
enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT_MODE = 4,
    CONTINUOUS_TIME = 8,
    STEPPING = 16,
    TERMINATED = 32,
    NEVER = 0,
    BEFORE_START = INSTANTIATED | INITIALIZATION,
    MODEL_EXCHANGE = EVENT_MODE | CONTINUOUS_TIME,
    ALWAYS = BEFORE_START | MODEL_EXCHANGE | STEPPING
};

/* All that a simulation changes: reset, FMU states and undoing a failed step copy it whole. */
typedef struct {
    double value[N_VARIABLES]; /* indexed by value reference */
    double slope[N_VARIABLES]; /* time derivatives of the inputs, for the next step only */
    unsigned phase;
    bool stale; /* derivatives and outputs do not fit the other values yet */
} State;

typedef struct {
    State state;
    fmi2Type type;
    char *instance_name;
    const fmi2CallbackFunctions *callbacks;
} Model;

/* The value of a variable by its name, wherever a `Model *m` is in scope. */
#define M(name) (m->state.value[V_##name])

/* Computes derivatives and outputs from all the other values: the one function a model defines. */
fmi2Status model_equations(Model *m);

/* Logs a message in printf's manner and returns fmi2Error. */
fmi2Status model_error(const Model *m, const char *format, ...);

#endif
