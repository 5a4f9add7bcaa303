/* What the wrapper must know of a repaired FMU: a file that `export` writes.
 *
 * Little-endian: a mark, the CRC-32 of what follows, its length, then the arrays of `ARRAYS` in
 * this order and two programs for each effect at an output. Each array is its length in bytes, as 64
 * bits, and its content, padded to a multiple of 8 bytes.
 */
#ifndef TABLE_H
#define TABLE_H
#include "core.h"

typedef struct {
    int32_t version, exchange; /* of the original: 2 or 3; whether it is integrated from outside */
    int32_t fixed_steps, n_states, n_indicators, completes_steps, interpolates, eventful;
    int32_t n_continuous; /* of the float64 scalars among the inputs, those that come first */
    int32_t n_inputs;     /* columns of the original's inputs; signals follow them */
} Facts;

typedef struct {
    double step, rtol, atol, max_steps, tolerance;
} Solver;

typedef enum { INPUT, SIGNAL, COEFFICIENT, BASE, START_VALUE, RATE, OUTPUT, STATE } Kind;

/* A reference of a real variable that is not simply the original's; `start` is its index among the
 * start values, or -1. */
typedef struct {
    uint32_t reference;
    int32_t kind, index, start;
} Answered;

enum { NO_HISTORY = -1, DELAY, BACKLASH, RATE_LIMIT, RATE_LIMIT_FROM_REST };
typedef struct {
    int32_t kind, column, coefficient;
} Memory;

/* Where the output stands in the row; its memory, a delay or a backlash of its first coefficient, or
 * NO_HISTORY; its own states among those of all of them; its coefficients. */
typedef struct {
    int32_t column, memory, first_state, n_states, first_coefficient, n_coefficients;
} OutputEffect;

/* A variable of FMI 3.0 that FMI 2.0 has other references for, so many from `first` on: its
 * elements; `kept` is where start values of an array are that can be set, or NOT_KEPT. */
enum { NOT_KEPT = -1 };
typedef struct {
    uint32_t first;
    int32_t size, element, kept;
} Place;

#define ARRAYS(X)                                                                         \
    X(Facts, facts) X(Solver, solver)                                                     \
    X(char, guid) X(char, original_guid) X(char, identifier) /* with a 0 at the end */    \
    X(uint8_t, program) X(uint8_t, rate) /* of the effects inside; of their own states */ \
    X(uint32_t, raw)                 /* references of inputs and signals: the columns */  \
    X(uint32_t, inputs)              /* those of float64 scalars, which come first */     \
    X(Element, input_elements) X(Element, continuous_elements)                            \
    X(double, raw_starts) X(double, coefficients) X(double, nominals)                     \
    X(uint32_t, varied) X(double, bases) X(uint32_t, starts) X(double, start_values)      \
    X(uint32_t, integers) X(int32_t, integer_values)                                      \
    X(uint32_t, booleans) X(int32_t, boolean_values) X(uint32_t, strings) X(char, texts)  \
    X(Memory, memories) X(OutputEffect, output_effects) X(uint32_t, row)                  \
    X(Answered, answered) X(uint32_t, affected) /* in the order of their references */    \
    X(Place, places) X(Element, elements) X(double, kept_elements) X(Element, structure)  \
    X(uint32_t, output) /* a float64 scalar that can be read, if there is one */

typedef struct {
    const uint8_t *at;
    size_t n;
} Bytes;

typedef struct {
#define FIELD(type, name) \
    const type *name;     \
    size_t n_##name;
    ARRAYS(FIELD)
#undef FIELD
    Bytes *programs; /* of each effect at an output two: the effect, and rate and decay */
    void *content;
} Table;

/* Read it. Returns NULL, or what is wrong. */
const char *table_read(Table *table, const char *path);
void table_free(Table *table);

#endif
