/* The core: simulations of an FMU, for many points in one call. This header is its whole interface.
 *
 * All memory that is handed over is plain: arrays of doubles and integers in C order, whose shapes
 * stand in brackets, and structures of them. The core keeps nothing between two calls but what
 * `core_program` makes, and has no global state. A failure is a code, with the time and the index
 * in the grid at which it happened; nothing is printed, and nothing ends the process.
 *
 * Letters: p points, t times of the grid, u inputs, x states, y outputs, c coefficients of effects.
 */
#ifndef CORE_H
#define CORE_H
#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__ELF__) /* each library of a process calls its own */
#define EXPORT __attribute__((visibility("protected")))
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* What became of a simulation. IS_FATAL is added where the instance must not be called any more. */
enum {
    FINISHED,
    INITIALISATION,
    STEP_FAILED,
    OUTPUT_FAILED,
    STEP_TOO_SMALL,
    TOO_MANY_STEPS,
    NOT_FINITE,
    EVENT,
    TERMINATED,
    LINEARISATION_FAILED,
    CHATTERING,
    DISCARDED,
    IS_PENDING,
    SENSITIVITIES_FAILED,
    HAS_EVENTS,
    ENDED_EARLY,
    NO_MEMORY,
    WRONG_SIZES,
    OUT_OF_STEPS,
    IS_FATAL = 100
};

enum { CO_SIMULATION, RUNGE_KUTTA, DORMAND_PRINCE, CVODE };

/* ---- the FMU ----------------------------------------------------------------------------- */

typedef void (*Function)(void); /* of a type that fmu.h knows */

/* Float64 Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean */
enum { N_TYPES = 11 };

/* An instance and its functions by address: NULL where a version or an interface has none. */
typedef struct {
    void *handle;
    Function reset, setup_experiment, enter_configuration_mode, exit_configuration_mode,
        enter_initialization_mode, exit_initialization_mode, set_string, set_time,
        set_continuous_states, get_continuous_states, get_nominals, get_derivatives,
        get_event_indicators, enter_event_mode, update_discrete_states, enter_continuous_time_mode,
        completed_integrator_step, do_step, set_real_input_derivatives, get_directional_derivative;
    Function get[N_TYPES], set[N_TYPES]; /* variables of each type; FMI 2.0 has three of them */
    double stop_unit; /* what it is told of the end: nothing (< 0), the time itself (0), or the next
                         multiple of this from the start on */
    size_t n_states, n_indicators;
    int32_t version;             /* 2 or 3 */
    int32_t interpolates_inputs; /* canInterpolateInputs */
    int32_t completes_steps;     /* it wants to know of accepted steps */
    int32_t eventful;            /* an input that jumps is an event */
} Fmu;

/* An element of a variable that is no float64 scalar: its type (index in `get`), value reference,
 * number of elements, and the column of this one; or column -1 and the bits of its value. */
typedef struct {
    int64_t type, reference, size, column, bits;
} Element;

/* The variables that the columns of a row of numbers belong to; float64 scalars are the first. */
typedef struct {
    const uint32_t *reals;
    const Element *elements;
    size_t n_reals, n_elements;
} Variables;

/* ---- the experiment ---------------------------------------------------------------------- */

typedef struct {
    double stop; /* the time at which a simulation will end */
    Variables structure, numbers; /* set before a simulation, from a row of `points` */
    const uint32_t *strings;
    const char *const *texts;
    size_t n_strings;
    Variables inputs, continuous_inputs, outputs; /* continuous: may be set between events */
    const double *times, *intervals; /* (t), (t) */
    const double *values, *slopes;   /* (t, u) inputs, then signals; 0 where one is held */
    const uint8_t *jumps;            /* (t) whether a held input jumps */
    const uint8_t *passed;           /* (t) whether a step may pass over it */
    Variables seen; /* in co-simulation: what the FMU computes and effects read, among its columns */
    size_t n_times, n_inputs, n_outputs;
    const int64_t *gather, *by_time, *row_ends; /* see workers.grid, for an early end; or NULL */
    const double *measured, *sigmas;
} Experiment;

typedef struct {
    double step;    /* the longest; 0: none is given */
    double rtol, atol;
    const double *atols; /* (x) */
    int64_t max_steps;   /* from one time of the grid to the next */
    double fmu_tolerance, fixed; /* fixed: the only communication step that the FMU takes, or 0 */
    int64_t all_steps; /* in a whole simulation, if the solver chooses them; 0: no limit */
} Settings;

/* Effects that act on every point of a batch. */
typedef struct Program Program;
typedef struct {
    const Program *program;      /* NULL for no effects */
    const uint32_t *parameters;  /* value references of those that effects change */
    const double *fastest_rates; /* (p) of their own states, as far as is known */
    const double *coefficients;  /* (p, c) */
    const double *base;          /* (p, parameters) values without effects */
} Effects;

/* Byte code from `workers.core.assemble`, checked and translated; NULL with a sentence in `wrong`
 * for what is none. It may be used by many batches at once. */
EXPORT Program *core_program(const void *bytes, size_t n_bytes, const char **wrong);
EXPORT void core_program_free(Program *program);

/* ---- simulations ------------------------------------------------------------------------- */

typedef struct Cvode Cvode;

/* One experiment for many points: what is asked, and where the answer goes. */
typedef struct {
    const Fmu *fmu;
    const Experiment *experiment;
    const Settings *settings;
    const Effects *effects;
    int64_t method;
    size_t n_points, n_values; /* (p, n_values) points: start values of `numbers`, `structure` */
    size_t n_states;           /* the FMU's and, behind them, the effects' own */
    size_t largest_array;      /* elements of the largest array variable */
    const double *points, *bounds; /* (p) sums of squares above which one may end early; inf */
    int64_t *progress; /* (4) called, simulations, running, steps: see workers.messages.types */
    double *outputs;   /* (p, t, y) */
    int64_t *codes, *indices, *steps; /* (p) index of the grid time before a failure */
    double *stopped_at;               /* (p) its time */
    Cvode *cvode;       /* for method CVODE */
    double *states_out; /* (t, x) states of the last point along the grid, or NULL */
} Batch;

/* Returns how many points were tried: all, or those up to the first that failed. */
EXPORT size_t core_simulate(const Batch *batch);

/* Whether the model is stiff at the first point: 0, 1, and in `codes` what went wrong. */
EXPORT int core_is_stiff(const Batch *batch);

/* CVODE's objects, and its functions by address: the same arguments in SUNDIALS 5 to 7. */
struct Cvode {
    void *memory, *state_vector, *work_vector; /* vectors around y and z */
    Function reinit, set_tolerances, set_jacobian, set_user_data, set_max_step, set_stop_time,
        integrate, interpolate, vector_data, matrix_data;
    double *y, *z; /* (x) */
    const uint32_t *jacobian_states, *jacobian_derivatives; /* (x) references, or NULL */
};

/* For CVodeInit, which wants a right-hand side from the start. */
EXPORT int core_right_hand_side(double time, void *y, void *ydot, void *user_data);

/* ---- linearisations along one simulation, of the first point ------------------------------ */

/* Nominal values of perturbed variables, and the bounds that the FMU declares. */
typedef struct {
    const double *nominals, *lows, *highs;
    size_t n;
} Range;

typedef struct {
    int64_t stepping;  /* DORMAND_PRINCE, RUNGE_KUTTA, or CVODE: to states that are there already */
    const Effects *offsets;   /* the effects with an offset at each input, behind all others */
    size_t first_offset;      /* the first of their coefficients */
    size_t n_inputs;          /* the FMU's; signals may follow them */
    Range states, inputs, parameters;
    const uint32_t *references;     /* of the parameters */
    const double *values;           /* of the parameters in this simulation */
    const int64_t *effect_positions; /* of each among the parameters that effects change, or -1 */
    double *x, *dx, *effective;     /* (t, x), (t, x), (t, u) */
    /* (t, x, x), (t, x, u), (t, x, p), (t, y, x), (t, y, u), (t, y, p) */
    double *A, *B, *P, *C, *D, *Q;
} Linearisation;

EXPORT int core_linearise(const Batch *batch, const Linearisation *linearisation);

/* An extended Kalman filter; see kalman.c. Linearisation without CVODE. */
typedef struct {
    const double *diffusion;           /* (x) q^2 of each state */
    const double *measured, *variances; /* (t, y) NaN where nothing was measured; R */
    double *innovations, *spreads;     /* (t, y) */
    double *covariance;                /* (x, x) at the start; at the end afterwards */
} Kalman;

EXPORT int core_filter(const Batch *batch, const Linearisation *linearisation,
                       const Kalman *kalman);

/* ---- forward sensitivities of the first point ---------------------------------------------- */

enum { INITIAL_STATES, KNOWN, DIFFERENCES };

typedef struct {
    size_t n; /* q parameters */
    const int64_t *kinds, *positions; /* (q) kind; position in a point */
    const uint32_t *references;       /* (q) */
    void *const *handles;             /* (q, 2) instances above and below its value */
    const double *values;             /* (q, 2) */
    const uint32_t *states, *derivatives;     /* (x) references */
    const uint32_t *outputs;          /* (a) references of outputs that are no states */
    const int64_t *output_positions;  /* (a) their positions among all */
    const int64_t *output_states;     /* (y) the state that an output is, or -1 */
    size_t n_outputs;                 /* a */
    double *sensitivities;            /* (t, q, y) */
} Sensitivities;

EXPORT int core_sensitivities(const Batch *batch, const Sensitivities *forward);
/* Start the FMU and get the derivative of `unknowns` by one variable; returns the status. */
EXPORT int core_is_known(const Batch *batch, const uint32_t *unknowns, size_t n, uint32_t known,
                         double *derivatives);

/* ---- effects at outputs, memories, and recursions of the screening ------------------------- */

typedef struct {
    const double *times, *values, *slopes; /* (t), (t, u), (t, u) */
    size_t n_times, n_inputs, n_outputs, column;
    const Program *program; /* its states are its own, then come the outputs */
    const double *coefficients;
    double rate, decay; /* of the fastest own state; of one that follows linearly, or 0 */
    double *outputs;    /* (t, y), of which a column is changed */
    const double *linear; /* (x, x) of several own states with x' = linear x + g(t), or NULL */
    size_t every;         /* times from one at which the output is asked for to the next */
} Record;

EXPORT int core_apply_to_outputs(const Record *record);

typedef struct {
    const double *times, *lengths, *values, *slopes, *outputs; /* (t), (t), (t, u), (t, u), (t, y) */
    const int64_t *first;  /* (t - 1) record that a cubic of an interval begins with */
    const uint8_t *smooth; /* (t - 1) whether there is a cubic */
    size_t n_times, n_inputs, n_outputs, pieces;
    double *at, *fine_values, *fine_slopes, *fine_outputs; /* the same at all pieces */
} Pieces;

EXPORT void core_refine(const Pieces *pieces);

/* Forms with memory: a signal (n) in, (at most room) out; returns the samples, or -1 for no
 * room. */
EXPORT int64_t core_delay(const double *times, const double *values, size_t n, double seconds,
                          double *at, double *out);
EXPORT int64_t core_backlash(const double *times, const double *values, size_t n,
                             double half_width, double *at, double *out);
EXPORT int64_t core_rate_limit(const double *times, const double *values, size_t n, int held,
                               double start, double fastest, double *at, double *out);

/* x' = keep x + from_first f + from_last f' from x = 0: m right-hand sides, in place of the
 * forcing. keep, from_first, from_last (t - 1, x, x), forcing (t, x, m), scratch (2, x, m). */
EXPORT void core_run_linear(const double *keep, const double *from_first, const double *from_last,
                            double *forcing, double *scratch, size_t t, size_t x, size_t m);
EXPORT void core_run_adjoint(const double *keep, const double *from_first, const double *from_last,
                             double *source, double *scratch, size_t t, size_t x, size_t m);

#endif
