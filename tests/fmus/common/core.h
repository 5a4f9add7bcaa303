/* The simulation behind both versions of the API: every function checks that it is allowed. */
#ifndef CORE_H
#define CORE_H

#include <string.h>

#include "model.h"

/* Returns what the model answers to a call of this function, if that is not OK. */
#define ANSWER(c)                                                                                  \
    do {                                                                                           \
        const int answer = model_answer(c, __func__ + strlen("fmi2"));                             \
        if (answer != OK)                                                                          \
            return answer;                                                                         \
    } while (0)

/* Each version of the API defines how a message reaches the caller. */
void log_error(const Model *m, const char *message);

Model *core_new(const char *name, const char *token, const char *resources, bool co_simulation,
                const void *callbacks, void *environment);
void core_free(Model *m);
int core_reset(Model *m);

/* Computes what is computed, if it does not fit the other values. */
int refresh(Model *m);
const char *phase_name(unsigned phase);
int require(const Model *m, unsigned phases, const char *function);
int check_size(const Model *m, size_t size, size_t expected, const char *function);

/* Where a variable's values are, and how many they are; NULL, with a message, if not allowed. */
const void *readable(Model *m, const char *function, unsigned reference, unsigned types,
                     size_t *count);
void *writable(Model *m, const char *function, unsigned reference, unsigned types,
               size_t *count);
int get_numbers(Model *m, const char *function, const unsigned references[], size_t n,
                unsigned types, size_t element, void *values, size_t n_values);
int set_numbers(Model *m, const char *function, const unsigned references[], size_t n,
                unsigned types, size_t element, const void *values, size_t n_values);
int get_texts(Model *m, const char *function, const unsigned references[], size_t n,
              const char *values[], size_t n_values);
int set_texts(Model *m, const char *function, const unsigned references[], size_t n,
              const char *const values[], size_t n_values);
int set_slopes(Model *m, const char *function, const unsigned references[], size_t n,
               const int order[], const double values[]);
int directional(Model *m, const char *function, const unsigned unknowns[], size_t n_unknowns,
                const unsigned knowns[], size_t n_knowns, const double seed[],
                double sensitivity[]);

int core_set_up(Model *m, const char *function, double start, bool stop_defined, double stop);
int core_enter_initialization(Model *m, const char *function);
int core_exit_initialization(Model *m, const char *function);
/* Is time a earlier than b, by more than rounding? */
bool earlier(double a, double b);
/* Iterates until nothing changes any more, as co-simulation must do by itself. */
int settle(Model *m, const char *function);
int core_enter_event_mode(Model *m, const char *function, unsigned from);
int core_update(Model *m, const char *function, Event *event);
int core_enter_continuous_time(Model *m, const char *function);
int core_completed_step(Model *m, const char *function, bool *enter_event_mode);
int core_terminate(Model *m, const char *function);

size_t count_states(const Model *m);
int core_set_time(Model *m, const char *function, double time);
int core_set_states(Model *m, const char *function, const double x[], size_t n);
/* Inputs with slopes run linearly from where `start` has them. */
void move_inputs(Model *m, const State *start, double offset);
int core_get_states(Model *m, const char *function, double x[], size_t n);
int core_get_derivatives(Model *m, const char *function, double x[], size_t n);
int core_get_nominals(Model *m, const char *function, double x[], size_t n);
int core_get_indicators(Model *m, const char *function, double z[], size_t n);

/* DISCARD when the model has asked for the end of the simulation. */
int core_do_step(Model *m, const char *function, double point, double step);

int core_get_state(Model *m, const char *function, void **saved);
int core_set_state(Model *m, const char *function, const void *saved);
int core_serialize(Model *m, const char *function, const void *saved, void *bytes, size_t size);
int core_deserialize(Model *m, const char *function, const void *bytes, size_t size,
                     void **saved);

#endif
