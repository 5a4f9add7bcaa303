/* An instance of the repaired FMU: the original, what acts on it, and where both stand. */
#ifndef WRAPPER_H
#define WRAPPER_H

#include "effects.h"
#include "fmi2.h"
#include "model.h"
#include "original.h"

/* C has no arrays without elements, so each has one more than it needs. */
#define ROOM(n) ((n) + 1)
#define N_INNER (N_STATES + N_OWN)            /* what acts while the model is integrated */
#define N_ALL (N_INNER + N_OUTPUT_OWN)        /* the continuous states of this FMU */
#define N_RAW (N_INPUTS + N_SIGNALS)
#define AT_LEAST_DISCARD(status) ((status) >= fmi2Discard)

typedef enum { INSTANTIATED, INITIALISING, EVENTS, RUNNING, ENDED } Phase;

/* A signal from a time on: value + slope (t - since). */
typedef struct {
    double since, value, slope;
} Segment;

/* What a signal was. */
typedef struct {
    Segment *segments;
    size_t count, capacity;
} History;

/* All that get and set state must keep, but histories and the original's own. */
typedef struct {
    Phase phase;
    double time;
    double states[ROOM(N_ALL)];
    double raw[ROOM(N_RAW)];             /* inputs, then signals, as they were set */
    double slopes[ROOM(N_RAW)];          /* their slopes, in co-simulation */
    Segment seen[ROOM(N_RAW)];           /* the same behind what has a memory */
    double coefficients[ROOM(N_COEFFICIENTS)];
    double base[ROOM(N_BASE)];           /* parameters that effects vary, without them */
    double starts[ROOM(N_STARTS)];       /* the estimates that this FMU begins with */
    double was[ROOM(N_RAW)];             /* what they were when the last step ended */
    double play[ROOM(N_INPUT_MEMORIES)]; /* what backlashes and limited rates have given last */
    double noted[ROOM(N_INPUT_MEMORIES)]; /* and when, in model exchange */
    double moves[ROOM(N_INPUT_MEMORIES)]; /* and how fast they move */
    double rows[ROOM(N_OUTPUT_EFFECTS)][ROOM(N_ROW)]; /* what each saw when the step began */
    double indicators[ROOM(N_INDICATORS)];
    double atols[ROOM(N_INNER)];
    double step;                         /* of co-simulation, the latest */
    double next_event, proposed;
    int dirty;                           /* the original does not know the inputs yet */
    int begun;                           /* the own states have been started */
    int in_event;                        /* in co-simulation: something discrete was set */
    int ended;                           /* the original has ended the simulation */
    Kept kept;
} Moving;

typedef struct {
    Original original;
    fmi2CallbackFunctions callbacks, inner;
    char *name;
    int simulates;                       /* instantiated for co-simulation */
    Moving now;
    History histories[ROOM(N_INPUT_MEMORIES + N_OUTPUT_EFFECTS)];
} Instance;

/* wrapper.c */
fmi2Status complain(Instance *c, fmi2Status status, const char *text);

/* values.c: the values of this FMU's own variables */
fmi2Status write_starts(Instance *c);
fmi2Status write_other_starts(Instance *c);

/* memory.c: delays, backlashes and limited rates */
void history_clear(History *history);
int history_copy(History *to, const History *from);
int history_note(History *history, double time, double value, double slope);
double history_at(const History *history, double at, double now, double value);
double see_inputs(Instance *c, double time, double end);
void pass_inputs(Instance *c, double begin, double end);
void sample_inputs(Instance *c);
void note_inputs(Instance *c);

/* motion.c: telling the original where it is, and asking it */
void take_inputs(const Instance *c, double time, double *raw);
fmi2Status write_inputs(Instance *c, double time, const double *states, int all);
fmi2Status first_inputs(Instance *c);
fmi2Status sync(Instance *c);
fmi2Status go_to(Instance *c, double time, const double *states);
fmi2Status derivative(Instance *c, double time, const double *states, int moved, double *result);
void begin_own_states(Instance *c);
fmi2Status all_derivatives(Instance *c, double *result);

/* outputs.c: effects at outputs */
fmi2Status output_rows(Instance *c, double rows[][ROOM(N_ROW)], double *last);
fmi2Status begin_outputs(Instance *c);
fmi2Status note_outputs(Instance *c);
fmi2Status advance_outputs(Instance *c, double begin, double end);

/* integrate.c, events.c: co-simulation of an original for model exchange */
fmi2Status integrate(Instance *c, double end, long *steps_left);
fmi2Status iterate_event(Instance *c);
fmi2Status handle_event(Instance *c);
fmi2Status find_event(Instance *c, double step, double stages[][ROOM(N_INNER)], double *trial,
                      double *part);
fmi2Status note_signs(Instance *c);
void polynomial(const Instance *c, double step, double part, double stages[][ROOM(N_INNER)],
                double *trial);

#endif
