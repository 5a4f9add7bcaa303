/* An instance of the repaired FMU: the original, the core's memory for one simulation of it, and
 * what acts on its inputs and outputs. */
#ifndef WRAPPER_H
#define WRAPPER_H
#include "exchange.h"
#include "fmi2.h"
#include "table.h"

/* Functions of an original beside those that the core calls; NULL where it has none. */
typedef int OfState(void *, void *);
typedef int StateSize(void *, void *, size_t *);
typedef int Serialise(void *, void *, char *, size_t);
typedef int DeSerialise(void *, const char *, size_t, void **);
typedef int GetStatus(void *, int, void *);
typedef struct {
    void *library;
    Fmu f; /* what the core calls; its handle is the instance */
    Function instantiate, free_instance, terminate, set_debug_logging, get_string, get_state,
        set_state, free_state, state_size, serialise, deserialise, get_real_status,
        get_boolean_status;
} Original;

typedef enum { INSTANTIATED, INITIALISING, EVENTS, SIMULATING, ENDED } Phase;

/* A signal from a time on: value + slope (t - since). */
typedef struct {
    double since, value, slope;
} Segment;

/* What a signal was. */
typedef struct {
    Segment *segments;
    size_t count, capacity;
    int is_cut; /* there was no memory for a segment */
} History;

/* What the original does not know yet: its inputs, or where it is at all. */
enum { NEW_INPUTS = 1, MOVED = 2 };

/* Numbers of the moment that no array has. */
typedef struct {
    double time, proposed, next_event;
    double tolerance, start, stop, reached; /* for FMI 3.0: what fmi2SetupExperiment has said, and
                                               where the latest step has ended */
    int32_t phase, dirty, tolerant, stops;
    int32_t begun;    /* the own states have been started */
    int32_t in_event; /* in co-simulation: something discrete was set */
    int32_t ended;    /* the original has ended the simulation */
    int32_t readable; /* for FMI 3.0: variables can be read */
} Moment;

/* Arrays that change: raw inputs and signals as they were set, with slopes in co-simulation; the
 * same behind what has a memory, from times[0] on (the same arrays, if nothing has); what they were when the last step ended; what
 * backlashes and limited rates have given last, when, and how fast they move; the rows that each
 * effect at an output saw, when a step began and when it ended; their own states. */
#define MOVING(X, t)                                                                            \
    X(times, 2) X(interval, 1) X(raw, t->n_raw) X(slopes, t->n_raw) X(seen, t->n_raw)           \
    X(seen_slopes, t->n_raw) X(was, t->n_raw) X(coefficients, t->n_coefficients)                \
    X(base, t->n_varied) X(starts, t->n_starts) X(play, t->n_memories) X(noted, t->n_memories)  \
    X(moves, t->n_memories) X(rows, 2 * t->n_row * t->n_output_effects)                         \
    X(outer, c->n_outer) X(kept_elements, t->n_kept_elements)

/* A program with registers of its own. */
typedef struct {
    Program *p;
    double *r;
} Evaluated;

/* An effect at an output. */
typedef struct {
    Record record;
    OutputRun run;
    Evaluated effect, motion; /* motion: rate and decay of its own states */
} Output;

typedef struct {
    Table table;
    const Facts *facts;
    Original original;
    fmi2CallbackFunctions callbacks, inner;
    char *name;
    int simulates; /* instantiated for co-simulation */
    int stale;     /* coefficients are not in the registers yet */
    Moment now;
    double *memory; /* of these: */
#define POINTER(name, n) double *name;
    MOVING(POINTER, _)
#undef POINTER
    size_t n_memory, n_outer, n_histories, n_states; /* states of this FMU */
    History *histories; /* of the memories, then of the effects at outputs */
    Output *outputs;
    Evaluated rate;
    uint32_t *direct; /* by reference, if they are small: the place among `answered`, from 1 */
    size_t n_direct;
    double *last, *found, *numbers; /* a row; derivatives of all states; elements of a variable */
    void *cells;                    /* the same in its own type */
    Work work;
    Batch batch;
    Experiment experiment;
    Settings settings;
    Effects effects;
    int64_t progress[4], results[4];
} Instance;

/* ---- original.c -------------------------------------------------------------------------- */

/* Load the library in a folder of resources and instantiate it. 0, or -1 with a sentence. */
int original_load(Instance *c, const char *resources, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length);
void original_free(Original *o);

/* ---- instance.c -------------------------------------------------------------------------- */

/* Everything but the original. Returns NULL, or what is wrong. */
const char *make_instance(Instance *c);
void free_instance(Instance *c);
/* As it was at first. */
void begin_again(Instance *c);
/* Coefficients and base values into the registers, if they are not there. */
void refresh(Instance *c);

/* ---- life.c: messages -------------------------------------------------------------------- */

void say(const Instance *c, int status, const char *category, const char *text);
int complain(const Instance *c, int status, const char *text);

/* ---- values.c ---------------------------------------------------------------------------- */

/* Start values that differ from the original's. */
int write_starts(Instance *c);
int write_other_starts(Instance *c);
int configure(Instance *c);
int get_row(Instance *c, double *row);

/* ---- memory.c: delays, backlashes and limited rates -------------------------------------- */

void history_clear(History *history);
int history_copy(History *to, const History *from);
int history_note(History *history, double time, double value, double slope);
double history_at(const History *history, double at, double now, double value);
int is_remembered(const Instance *c);
double see_memories(Instance *c, double time, double end);
static inline double see_inputs(Instance *c, double time, double end) {
    if (UNLIKELY(c->table.n_memories > 0)) return see_memories(c, time, end);
    c->times[0] = time;
    return end;
}
void pass_inputs(Instance *c, double begin, double end);
void sample_inputs(Instance *c);
void note_inputs(Instance *c);

/* ---- motion.c: telling the original where it is, and asking it --------------------------- */

int write_inputs(Instance *c, int all);
int first_inputs(Instance *c);
int sync(Instance *c);
int begin(Instance *c);
int all_derivatives(Instance *c, double *result);
int enter_event(Instance *c);
int handle_event_here(Instance *c);
/* What became of steps of the core, as a status. */
int explain(Instance *c, int code);

/* ---- outputs.c: effects at outputs ------------------------------------------------------- */

/* What each effect sees, into its row at the begin of a step, and in `last` what all of them make
 * of it. */
int output_rows(Instance *c, double *last);
int begin_outputs(Instance *c);
int note_outputs(Instance *c);
int advance_outputs(Instance *c);
void output_derivatives(Instance *c, double *result);

#endif
