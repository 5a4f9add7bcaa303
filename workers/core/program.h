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

/* UNARY(name, value, d/da), BINARY(name, value, d/da, d/db), of operands a and b; v is the value.
 * Comparisons give 1 or 0, and their derivatives are 0. */
#define OPERATIONS(UNARY, BINARY)                                                     \
    UNARY(MOVE, a, 1.0)                                                               \
    BINARY(ADD, a + b, 1.0, 1.0)                                                      \
    BINARY(MULTIPLY, a *b, b, a)                                                      \
    BINARY(SUBTRACT, a - b, 1.0, -1.0)                                                \
    BINARY(DIVIDE, a / b, 1.0 / b, -v / b)                                            \
    BINARY(LEAST, b < a ? b : a, b < a ? 0.0 : 1.0, b < a ? 1.0 : 0.0)                \
    BINARY(LARGEST, a < b ? b : a, a < b ? 0.0 : 1.0, a < b ? 1.0 : 0.0)              \
    UNARY(NEGATE, -a, -1.0)                                                           \
    UNARY(ABSOLUTE, fabs(a), SIGN_OF(a))                                              \
    UNARY(SIGN, SIGN_OF(a), 0.0)                                                      \
    UNARY(ROOT, sqrt(a), 0.5 / v)                                                     \
    UNARY(EXP, ce_exp(a), v)                                                          \
    UNARY(LOG, ce_log(a), 1.0 / a)                                                    \
    UNARY(SIN, ce_sin(a), ce_cos(a))                                                  \
    UNARY(COS, ce_cos(a), -ce_sin(a))                                                 \
    UNARY(TAN, ce_tan(a), 1.0 + v * v)                                                \
    UNARY(TANH, ce_tanh(a), 1.0 - v * v)                                              \
    UNARY(ATAN, ce_atan(a), 1.0 / (1.0 + a * a))                                      \
    BINARY(POW, ce_pow(a, b), b == 0.0 ? 0.0 : b * ce_pow(a, b - 1.0),                \
           a > 0.0 ? v * ce_log(a) : 0.0)                                             \
    BINARY(LESS, (double)(a < b), 0.0, 0.0)                                           \
    BINARY(LESS_OR_EQUAL, (double)(a <= b), 0.0, 0.0)                                 \
    BINARY(EQUAL, (double)(a == b), 0.0, 0.0)                                         \
    BINARY(UNEQUAL, (double)(a != b), 0.0, 0.0)                                       \
    BINARY(AND, (double)((a != 0.0) & (b != 0.0)), 0.0, 0.0)                          \
    BINARY(OR, (double)((a != 0.0) | (b != 0.0)), 0.0, 0.0)                           \
    UNARY(NOT, (double)(a == 0.0), 0.0)

enum {
    END,
#define NAME1(name, value, da) name,
#define NAME2(name, value, da, db) name,
    OPERATIONS(NAME1, NAME2)
#undef NAME1
#undef NAME2
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
    uint32_t n_sites, n_added;             /* those that add come first */
    uint32_t first_input, first_coefficient, first_base, first_effective, first_parameter,
        first_constant, first_temporary;
    double *constants;
    Instruction *code[N_PIECES];
    Step *fast[N_PIECES];
    Site *sites;
};

/* The machines, all with the same bits: one instruction after the other; with derivatives in n
 * directions, register i being r[i * (n + 1)], its derivatives behind; at BLOCK points at once,
 * register i being r[i * BLOCK] and following; and the fast one. */
enum { BLOCK = 64 };
void run(const Instruction *code, double *r);
void run_dual(const Instruction *code, double *r, size_t n);
void run_block(const Instruction *code, double *r);
static inline void run_fast(const Step *code, double *r) { code->action(code, r, 0.0); }

int n_operands(uint16_t operation);
/* Make steps for the fast machine, at most as many as instructions. Registers from
 * `first_temporary` on may be left unwritten, but for those of `wanted`. */
void translate(const Instruction *code, uint32_t first_temporary, const uint16_t *wanted,
               size_t n_wanted, Step *steps);

#endif
