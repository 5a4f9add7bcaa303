/* Byte code of effects: straight lines of double precision on a file of registers.
 *
 * The registers are one array of doubles:
 *
 *     time | states | inputs | coefficients | base values | effective inputs | effective parameters
 *     | constants | temporaries
 *
 * A simulation's own time, trial states and inputs ARE the first registers, so that nothing is
 * copied before an evaluation. An instruction is 8 bytes, "to = a op b".
 */
#ifndef PROGRAM_H
#define PROGRAM_H
#include "core.h"

/* Of a number that is none it is none: that has a sign too, but another on each processor. */
#define SIGN_OF(a) (a > 0.0 ? 1.0 : a < 0.0 ? -1.0 : a == 0.0 ? 0.0 : a)

/* UNARY(name, value), BINARY(name, value), of operands a and b; comparisons give 1 or 0. */
#define OPERATIONS(UNARY, BINARY)                          \
    UNARY(MOVE, a)                                         \
    BINARY(ADD, a + b)                                     \
    BINARY(MULTIPLY, a *b)                                 \
    BINARY(SUBTRACT, a - b)                                \
    BINARY(DIVIDE, a / b)                                  \
    BINARY(LEAST, b < a ? b : a)                           \
    BINARY(LARGEST, a < b ? b : a)                         \
    UNARY(NEGATE, -a)                                      \
    UNARY(ABSOLUTE, fabs(a))                               \
    UNARY(SIGN, SIGN_OF(a))                                \
    UNARY(ROOT, sqrt(a))                                   \
    UNARY(EXP, ce_exp(a))                                  \
    UNARY(LOG, ce_log(a))                                  \
    UNARY(SIN, ce_sin(a))                                  \
    UNARY(COS, ce_cos(a))                                  \
    UNARY(TAN, ce_tan(a))                                  \
    UNARY(TANH, ce_tanh(a))                                \
    UNARY(ATAN, ce_atan(a))                                \
    BINARY(POW, ce_pow(a, b))                              \
    BINARY(LESS, (double)(a < b))                          \
    BINARY(LESS_OR_EQUAL, (double)(a <= b))                \
    BINARY(EQUAL, (double)(a == b))                        \
    BINARY(UNEQUAL, (double)(a != b))                      \
    BINARY(AND, (double)((a != 0.0) & (b != 0.0)))         \
    BINARY(OR, (double)((a != 0.0) | (b != 0.0)))          \
    UNARY(NOT, (double)(a == 0.0))

enum {
    END,
#define NAME(name, value) name,
    OPERATIONS(NAME, NAME)
#undef NAME
    CHOOSE, /* to = a != 0 ? b : to */
    N_OPERATIONS
};

typedef struct {
    uint16_t operation, to, a, b;
} Instruction;

/* A step of the accumulator machine, see machine.c; in memory only. */
typedef struct Step {
    double (*action)(const struct Step *, double *, double);
    uint16_t a, b, to, c;
} Step;

typedef struct {
    uint16_t state, r; /* the register whose value changes a state's derivative, or is it */
} Site;

/* Pieces of code, each with an END: what depends on coefficients and base values alone (once a
 * simulation), own states at the start, effective inputs and parameters (before the FMU is asked),
 * and what changes derivatives (after). */
enum { ONCE, START, BEFORE, AFTER, N_PIECES };

struct Program {
    uint32_t n_registers, n_states, n_own, n_inputs, n_coefficients, n_base, n_constants;
    uint32_t n_parameters, changes_inputs; /* effective parameters; whether there is a BEFORE */
    uint32_t n_sites, n_added; /* those that add to derivatives, of the FMU's states, come first;
                                  the others are derivatives, of which each own state has one */
    uint32_t first_input, first_coefficient, first_base, first_effective, first_parameter,
        first_constant, first_temporary;
    double *constants;
    Instruction *code[N_PIECES];
    Step *fast[N_PIECES];
    Site *sites;
};

/* Run a piece that was translated. */
static inline void run_fast(const Step *code, double *r) { code->action(code, r, 0.0); }
/* Make steps of instructions, at most as many as instructions. Registers from
 * `first_temporary` on may be left unwritten, but for those of `wanted`. */
void translate(const Instruction *code, uint32_t first_temporary, const uint16_t *wanted,
               size_t n_wanted, Step *steps);

#endif
