/* The machine that runs effects: an accumulator, and a jump from each operation to the next.
 *
 * The last value stays in a register of the processor: x. Each operation has the forms "x = x op
 * r", "x = r op x" and "x = r op r", and each of them once more with "r = x" behind it for a value
 * that is read later. Each form is a function that ends in a jump to the next one's, whose address
 * is in the code. The operations, their operands and their order are those of the instructions, and
 * so the bits are too.
 *
 * Reference for direct threading: J. R. Bell, Comm. ACM 16 (1973) 370-372,
 * doi:10.1145/362248.362270.
 */
#include <math.h>

#include "elementary.h"
#include "program.h"

#if defined(__clang__) || __GNUC__ >= 15
#define NEXT __attribute__((musttail)) return i[1].action(i + 1, r, x)
#else /* gcc makes jumps of these with -O2 too, though nothing promises it */
#define NEXT return i[1].action(i + 1, r, x)
#endif
#define STEP(name) static double name(const Step *i, double *r, double x)

STEP(do_end) {
    (void)i, (void)r;
    return x;
}
STEP(do_store) { /* of a value that a register has already: MOVE */
    r[i->to] = x;
    NEXT;
}
STEP(do_choose) {
    x = r[i->a] != 0.0 ? r[i->b] : r[i->to];
    r[i->to] = x;
    NEXT;
}
#define STORE_keeping (void)0
#define STORE_storing r[i->to] = x
#define FORM(name, ends, operands, value) \
    STEP(do_##name##ends) {               \
        operands;                         \
        x = value;                        \
        STORE##ends;                      \
        NEXT;                             \
    }
#define BOTH_ENDS(name, operands, value)     \
    FORM(name, _keeping, operands, value) \
    FORM(name, _storing, operands, value)
#define DO1(name, value)                          \
    BOTH_ENDS(name, const double a = x, value)    \
    BOTH_ENDS(of_##name, const double a = r[i->a], value)
#define DO2(name, value)                                                           \
    BOTH_ENDS(name, const double a = x; const double b = r[i->b], value)           \
    BOTH_ENDS(with_##name, const double a = r[i->a]; const double b = x, value)    \
    BOTH_ENDS(of_##name, const double a = r[i->a]; const double b = r[i->b], value)
OPERATIONS(DO1, DO2)

/* A product and what is done with it, where nothing else reads it: "p = x * r" or "p = r * r", then
 * "p op r", "r op p", "p op x" or "x op p". Two roundings, as in two steps. */
#define WITH_PRODUCT(FUSED)      \
    FUSED(ADD, a + b)            \
    FUSED(SUBTRACT, a - b)       \
    FUSED(MULTIPLY, a *b)
#define SIX_FORMS(DO, name, value) \
    DO(name, x, p, r, value)       \
    DO(name, x, r, p, value)       \
    DO(name, r, p, r, value)       \
    DO(name, r, r, p, value)       \
    DO(name, r, p, x, value)       \
    DO(name, r, x, p, value)
#define FACTOR_x x
#define FACTOR_r r[i->a]
#define OPERAND_p p
#define OPERAND_x x
#define OPERAND_r r[i->c]
#define PRODUCT_FORM(name, factor, one, other, value)                          \
    BOTH_ENDS(name##_##factor##_##one##other,                                  \
              const double p = FACTOR_##factor * r[i->b];                      \
              const double a = OPERAND_##one; const double b = OPERAND_##other, value)
#define DO_FUSED(name, value) SIX_FORMS(PRODUCT_FORM, name, value)
WITH_PRODUCT(DO_FUSED)

typedef double Action(const Step *, double *, double);
enum { OF_X, OF_R_AND_X, OF_R };
#define PAIR(name) {do_##name##_keeping, do_##name##_storing}
/* [operation][where the operands are][whether the value is stored] */
static Action *const forms[][3][2] = {
    {{do_end, do_end}},
#define OF1(name, value) {PAIR(name), {0}, PAIR(of_##name)},
#define OF2(name, value) {PAIR(name), PAIR(with_##name), PAIR(of_##name)},
    OPERATIONS(OF1, OF2)};
/* [operation][x * r or r * r][p op r, r op p, p op x, x op p][stored] */
static Action *const fused_forms[][2][4][2] = {
#define FUSED_OF(name, value)                                                \
    [name] = {{PAIR(name##_x_pr), PAIR(name##_x_rp), {0}, {0}},              \
              {PAIR(name##_r_pr), PAIR(name##_r_rp), PAIR(name##_r_px), PAIR(name##_r_xp)}},
    WITH_PRODUCT(FUSED_OF)};

/* ---- translation ------------------------------------------------------------------------- */

static int n_operands(uint16_t operation) {
    static const uint8_t operands[] = {
        0,
#define N1(name, value) 1,
#define N2(name, value) 2,
        OPERATIONS(N1, N2) 2};
    return operands[operation];
}

typedef struct {
    const Instruction *code;
    uint32_t first_temporary;
    const uint16_t *wanted;
    size_t n_wanted;
} Source;

static int reads(const Instruction *i, uint16_t r) {
    return i->a == r || (n_operands(i->operation) > 1 && i->b == r)
           || (i->operation == CHOOSE && i->to == r);
}

/* Whether register r is read from code[i] on, before it is written anew, or wanted at the end. */
static int is_needed(const Source *s, size_t i, uint16_t r) {
    if (r < s->first_temporary) return 1;
    for (; s->code[i].operation != END; i++) {
        if (reads(&s->code[i], r)) return 1;
        if (s->code[i].to == r) return 0;
    }
    for (size_t j = 0; j < s->n_wanted; j++)
        if (s->wanted[j] == r) return 1;
    return 0;
}

/* Whether instruction i is a product that only instruction i + 1 reads, once, in one of its
 * sums. */
static int fuses(const Source *s, size_t i) {
    const Instruction *c = s->code + i, *next = c + 1;
    if (c->operation != MULTIPLY) return 0;
    if (next->operation != ADD && next->operation != SUBTRACT && next->operation != MULTIPLY)
        return 0;
    if ((next->a == c->to) == (next->b == c->to)) return 0;
    return next->to == c->to ? c->to >= s->first_temporary : !is_needed(s, i + 2, c->to);
}

/* Whether the value that instruction i leaves in the accumulator must be stored too: not if the
 * next step reads it from there, and nothing reads it later. */
static int must_store(const Source *s, size_t i) {
    const Instruction *next = s->code + i + 1;
    const uint16_t r = s->code[i].to;
    if (r < s->first_temporary || next->operation == END || next->operation == CHOOSE)
        return is_needed(s, i + 1, r);
    if (fuses(s, i + 1)) {
        const Instruction *then = next + 1;
        const int in_product = (next->a == r) + (next->b == r);
        const int in_sum = (then->a == r) + (then->b == r);
        if (in_product + in_sum == 1) return then->to != r && is_needed(s, i + 3, r);
        return is_needed(s, i + 1, r);
    }
    const int times = (next->a == r) + (n_operands(next->operation) > 1 && next->b == r);
    return times == 1 ? next->to != r && is_needed(s, i + 2, r) : is_needed(s, i + 1, r);
}

void translate(const Instruction *code, uint32_t first_temporary, const uint16_t *wanted,
               size_t n_wanted, Step *steps) {
    const Source source = {code, first_temporary, wanted, n_wanted}, *const s = &source;
    int held = -1; /* the register whose value the accumulator has */
    for (size_t i = 0; code[i].operation != END; i++, steps++) {
        const Instruction *c = &code[i], *next = c + 1;
        const int a_held = c->a == held, b_held = n_operands(c->operation) > 1 && c->b == held;
        if (c->operation == CHOOSE) {
            *steps = (Step){do_choose, c->a, c->b, c->to, 0};
            held = c->to;
            continue;
        }
        if (fuses(s, i)) {
            const int left = next->a == c->to; /* the product is */
            const uint16_t other = left ? next->b : next->a;
            const int of_x = a_held != b_held, with_x = !of_x && other == held;
            if (!(of_x && other == held)) {
                const int form = 2 * with_x + !left;
                *steps = (Step){fused_forms[next->operation][!of_x][form][must_store(s, i + 1)],
                                c->a, of_x && b_held ? c->a : c->b, next->to, other};
                held = next->to;
                i++;
                continue;
            }
        }
        const int where = a_held && !b_held ? OF_X : b_held && !a_held ? OF_R_AND_X : OF_R;
        *steps = (Step){forms[c->operation][where][must_store(s, i)], c->a, c->b, c->to, 0};
        if (c->operation == MOVE && where == OF_X) steps->action = do_store;
        held = c->to;
    }
    *steps = (Step){do_end, 0, 0, 0, 0};
}
