/* Programs: read from bytes, and checked.
 *
 * Little-endian: the mark, sixteen counts of 32 bits (`Header`), the constants, the pieces of code
 * each with its END, and the sites. */
#include "program.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    char mark[8];
    uint32_t n_registers, n_states, n_own, n_inputs, n_coefficients, n_base, n_constants;
    uint32_t n_parameters, changes_inputs, n_sites, n_added, n_code[N_PIECES], unused;
} Header;

static const char mark[8] = "CECORE1";

/* Whether all registers and operations exist, and the piece ends where it must. */
static int is_sound(const Program *p, const Instruction *code, size_t n) {
    for (size_t i = 0; i < n; i++) {
        if (code[i].operation == END) return i + 1 == n;
        if (code[i].operation >= N_OPERATIONS || code[i].to >= p->n_registers
            || code[i].to < 1 || code[i].a >= p->n_registers || code[i].b >= p->n_registers)
            return 0;
    }
    return 0;
}

/* Whether no piece writes what belongs to others: inputs, coefficients and constants, nor states
 * but at the start, nor effective values but before the FMU is asked. */
static int writes_its_own(const Program *p, int piece) {
    for (const Instruction *i = p->code[piece]; i->operation != END; i++) {
        const uint16_t to = i->to;
        const int own_state = to > p->n_states - p->n_own && to <= p->n_states;
        const int effective = to >= p->first_effective && to < p->first_constant;
        if (to >= p->first_temporary || (piece == START && own_state)
            || (piece == BEFORE && effective))
            continue;
        return 0;
    }
    return 1;
}

/* Whether what is added goes to derivatives of the FMU's states, and each own state has one. */
static int has_derivatives(const Program *p) {
    const uint32_t first_own = p->n_states - p->n_own;
    if (p->n_sites - p->n_added != p->n_own) return 0;
    for (uint32_t s = 0; s < p->n_sites; s++) {
        const Site *at = &p->sites[s];
        if (at->state >= p->n_states || at->r >= p->n_registers) return 0;
        if ((s < p->n_added) != (at->state < first_own)) return 0;
    }
    for (uint32_t own = first_own; own < p->n_states; own++) {
        uint32_t s = p->n_added;
        while (s < p->n_sites && p->sites[s].state != own) s++;
        if (s == p->n_sites) return 0;
    }
    return 1;
}

static void lay_out(Program *p) {
    p->first_input = 1 + p->n_states;
    p->first_coefficient = p->first_input + p->n_inputs;
    p->first_base = p->first_coefficient + p->n_coefficients;
    p->first_effective = p->first_base + p->n_base;
    p->first_parameter = p->first_effective + (p->changes_inputs ? p->n_inputs : 0);
    p->first_constant = p->first_parameter + p->n_parameters;
    p->first_temporary = p->first_constant + p->n_constants;
}

static const char *translate_all(Program *p) {
    /* What a piece leaves for others: ONCE all that it computes, AFTER what changes derivatives. */
    size_t n_once = 0, i = 0;
    while (p->code[ONCE][n_once].operation != END) n_once++;
    uint16_t *wanted = malloc((n_once + p->n_sites + 1) * sizeof *wanted);
    if (wanted == NULL) return "no memory";
    for (; i < n_once; i++) wanted[i] = p->code[ONCE][i].to;
    for (uint32_t s = 0; s < p->n_sites; s++) wanted[i++] = p->sites[s].r;
    for (int piece = 0; piece < N_PIECES; piece++)
        translate(p->code[piece], p->first_temporary, wanted, i, p->fast[piece]);
    free(wanted);
    return NULL;
}

static const char *fill(Program *p, const Header *h, const char *bytes) {
    size_t n_code = 0;
    lay_out(p);
    if (p->n_registers > UINT16_MAX || p->first_temporary > p->n_registers || p->n_own > p->n_states
        || p->n_added > p->n_sites || (p->n_parameters > 0 && !p->changes_inputs))
        return "byte code whose counts do not fit each other";
    for (int piece = 0; piece < N_PIECES; piece++) n_code += h->n_code[piece];
    /* one block: constants, steps, code, sites; all are aligned to what they need in this order */
    char *m = malloc(p->n_constants * sizeof(double) + n_code * (sizeof(Step) + sizeof(Instruction))
                     + p->n_sites * sizeof(Site) + 1);
    if (m == NULL) return "no memory";
    p->constants = (double *)m;
    Step *steps = (Step *)(m + p->n_constants * sizeof(double));
    Instruction *code = (Instruction *)(steps + n_code);
    p->sites = (Site *)(code + n_code);
    memcpy(p->constants, bytes, p->n_constants * sizeof(double));
    bytes += p->n_constants * sizeof(double);
    memcpy(code, bytes, n_code * sizeof *code);
    memcpy(p->sites, bytes + n_code * sizeof *code, p->n_sites * sizeof(Site));
    for (int piece = 0; piece < N_PIECES; piece++) {
        p->code[piece] = code, p->fast[piece] = steps;
        if (!is_sound(p, code, h->n_code[piece]) || !writes_its_own(p, piece))
            return "byte code with an instruction that is none";
        code += h->n_code[piece], steps += h->n_code[piece];
    }
    if (!has_derivatives(p)) return "byte code with derivatives of other states than it must have";
    return translate_all(p);
}

Program *core_program(const void *bytes, size_t n_bytes, const char **wrong) {
    Header h;
    *wrong = "bytes that are no effects of this version";
    if (n_bytes < sizeof h) return NULL;
    memcpy(&h, bytes, sizeof h);
    uint64_t size = sizeof h + 8 * (uint64_t)h.n_constants + 4 * (uint64_t)h.n_sites;
    for (int piece = 0; piece < N_PIECES; piece++) size += 8 * (uint64_t)h.n_code[piece];
    const uint32_t counts[] = {h.n_states, h.n_inputs, h.n_coefficients, h.n_base, h.n_parameters,
                               h.n_constants};
    for (size_t j = 0; j < sizeof counts / sizeof *counts; j++)
        if (counts[j] > UINT16_MAX) return NULL;
    if (memcmp(h.mark, mark, sizeof mark) != 0 || size != n_bytes) return NULL;
    *wrong = "no memory";
    Program *p = calloc(1, sizeof *p);
    if (p == NULL) return NULL;
    p->n_registers = h.n_registers, p->n_states = h.n_states, p->n_own = h.n_own;
    p->n_inputs = h.n_inputs, p->n_coefficients = h.n_coefficients, p->n_base = h.n_base;
    p->n_constants = h.n_constants, p->n_parameters = h.n_parameters;
    p->changes_inputs = h.changes_inputs != 0, p->n_sites = h.n_sites, p->n_added = h.n_added;
    *wrong = fill(p, &h, (const char *)bytes + sizeof h);
    if (*wrong == NULL) return p;
    core_program_free(p);
    return NULL;
}

void core_program_free(Program *p) {
    if (p != NULL) free(p->constants);
    free(p);
}
