/* What a test model and the two versions of the FMI see of the scaffold. */
#ifndef MODEL_H
#define MODEL_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "version.h" /* generated: defines FMI as 2 or 3 */

enum { TEXT_SIZE = 64 };

typedef double Float64;
typedef float Float32;
typedef int8_t Int8;
typedef int16_t Int16;
typedef int32_t Int32;
typedef int64_t Int64;
typedef uint8_t UInt8;
typedef uint16_t UInt16;
typedef uint32_t UInt32;
typedef uint64_t UInt64;
typedef char String[TEXT_SIZE];
typedef struct {
    size_t size;
    uint8_t bytes[TEXT_SIZE];
} Binary;

#if FMI == 2
typedef int Boolean;
typedef int Enumeration;
#else
typedef bool Boolean;
typedef int64_t Enumeration;
#endif

/* Types of variables, one bit each, so that what a function may access is one mask. */
enum {
    FLOAT64 = 1, FLOAT32 = 2, INT8 = 4, INT16 = 8, INT32 = 16, INT64 = 32, UINT8 = 64,
    UINT16 = 128, UINT32 = 256, UINT64 = 512, BOOLEAN = 1024, ENUMERATION = 2048,
    STRING = 4096, BINARY = 8192
};

/* Phases of an instance, likewise. */
enum {
    INSTANTIATED = 1,
    CONFIGURATION = 2,
    INITIALIZATION = 4,
    EVENT_MODE = 8,
    CONTINUOUS_TIME = 16,
    STEPPING = 32,
    TERMINATED = 64,
    MODEL_EXCHANGE = EVENT_MODE | CONTINUOUS_TIME,
    RUNNING = INITIALIZATION | MODEL_EXCHANGE | STEPPING | TERMINATED
};

#include "model_variables.h" /* generated from model.toml */

/* All that a simulation changes: reset, FMU states and undoing a step copy it whole. */
typedef struct {
    Values v;
    double slope[N_VARIABLES]; /* time derivatives of the inputs, for the next step only */
    double next_event;         /* INFINITY when none is scheduled */
    double last_event;         /* nobody may go back before it */
    double stop;
    unsigned phase;
    bool stale;    /* derivatives and outputs do not fit the other values yet */
    bool set_up;   /* the start time is known */
    bool updating; /* the event iteration is not finished */
    bool ended;    /* the model has asked for the end of the simulation */
} State;

typedef struct {
    State state;
    bool co_simulation;
    bool logging_on;
    char *instance_name;
    const void *callbacks; /* what the logger needs, in the manner of the version */
    void *environment;
} Model;

/* What follows from one round of event iteration. */
typedef struct {
    bool again, terminate, nominals_changed, states_changed;
    double next_time; /* INFINITY for none */
} Event;

enum { OK = 0, DISCARD = 2, ERROR = 3, FATAL = 4 }; /* the same numbers in both versions */

/* The value of a variable by its name, wherever a `Model *m` is in scope. */
#define M(name) (m->state.v.name)

/* Logs a message in printf's manner and returns ERROR. */
int error(const Model *m, const char *format, ...);

/* ---- what a model defines: the equations, and what else it needs -------------------------- */

/* Computes derivatives, event indicators and outputs from all the other values. FATAL reaches the
   caller at the end of the initialisation or of a step; elsewhere it is an ERROR. */
int model_equations(Model *m);
/* Changes discrete values and states: one round of event iteration. */
void model_event(Model *m, Event *event);
/* Says whether a completed step calls for event mode. */
bool model_step_completed(Model *m);
/* Says whether a completed step calls for the end of the simulation. */
bool model_step_ends(Model *m);
/* What a call returns at once, by the function's name behind `fmi2` or `fmi3`; OK to go on. */
int model_answer(Model *m, const char *function);
/* The derivative of one variable to another, by value reference; NaN if it is not provided. */
double model_partial(Model *m, unsigned unknown, unsigned known);
/* The nominal value of a state (its place among the states). */
double model_nominal(Model *m, size_t state);
/* Says whether states that are no numbers are taken. */
bool model_takes_any_state(void);
/* Says whether event indicators are returned as they are, without being computed. */
bool model_is_lazy(void);
/* The number of which communication steps must be exact multiples; 0 for any step. */
double model_step_unit(void);
/* The longest communication step that is taken. */
double model_longest_step(void);
/* Says whether a variable cannot be set, whatever the description says. */
bool model_refuses(const char *name);
/* Refuses an instance by returning ERROR, for what is at the location of its resources. */
int model_resources(Model *m, const char *location);
/* Refuses an instance by returning ERROR. */
int model_accept(Model *m);
/* Called before an instance is freed. */
void model_free(Model *m);
/* Called when initialisation ends. */
void model_start(Model *m);
/* Called after a reset with the values that were there before. */
void model_reset(Model *m, const Values *before);

#endif
