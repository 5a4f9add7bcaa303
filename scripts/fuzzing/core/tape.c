#include "tape.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "program.h"

uint8_t next_byte(Tape *tape) {
    if (tape->size == 0) return 0;
    if (tape->at >= tape->size) tape->at = 0;
    return tape->bytes[tape->at++];
}

size_t below(Tape *tape, size_t n) { return next_byte(tape) % n; }

double one_of(Tape *tape, const double *numbers, size_t n) { return numbers[below(tape, n)]; }

double next_number(Tape *tape) {
    static const double special[] = {
        NAN, -NAN, INFINITY, -INFINITY, -0.0, 1e308, -1e308, 5e-324, -5e-324, 1e-300, 1e16, -1e16,
        1e-9, 1.0000000000000002, 0.9999999999999999, 745.0, 4294967296.0, 9223372036854775808.0};
    enum { N = sizeof special / sizeof *special };
    const uint8_t b = next_byte(tape);
    if (b == 255) {
        uint8_t bits[8];
        double value;
        for (size_t j = 0; j < sizeof bits; j++) bits[j] = next_byte(tape);
        memcpy(&value, bits, sizeof value);
        return value;
    }
    return b >= 255 - N ? special[b - (255 - N)] : ((double)b - 100.0) / 16.0;
}

/* ---- memory ------------------------------------------------------------------------------ */

enum { MOST_ARRAYS = 400 };
static void *arrays[MOST_ARRAYS];
static size_t n_arrays;

void *new_array(size_t n, size_t size) {
    void *const array = malloc(n * size);
    if (n_arrays == MOST_ARRAYS || (array == NULL && n * size > 0)) found("no memory");
    memset(array, 0, n * size);
    return arrays[n_arrays++] = array;
}

double *new_numbers(size_t n, Tape *filled_from) {
    double *const numbers = new_array(n, sizeof *numbers);
    for (size_t j = 0; filled_from != NULL && j < n; j++) numbers[j] = next_number(filled_from);
    return numbers;
}

void free_arrays(void) {
    while (n_arrays > 0) free(arrays[--n_arrays]);
}

void found(const char *what) {
    fprintf(stderr, "found: %s\n", what);
    abort();
}

/* ---- byte code --------------------------------------------------------------------------- */

enum { MOST_INSTRUCTIONS = 24, MOST_CONSTANTS = 4, TEMPORARIES = 4 }; /* of each piece */

typedef struct {
    uint8_t *at;
} Writer;

static void put(Writer *w, const void *bytes, size_t n) {
    memcpy(w->at, bytes, n);
    w->at += n;
}

/* A register that a piece may write: a temporary one, or what only this piece may. */
static size_t target(Tape *tape, const Counts *c, int piece, size_t first_effective,
                     size_t first_temporary, size_t n_effective) {
    const int special = next_byte(tape) % 3 == 0;
    if (special && piece == START && c->own > 0)
        return 1 + c->states - c->own + below(tape, c->own);
    if (special && piece == BEFORE && n_effective > 0)
        return first_effective + below(tape, n_effective);
    return first_temporary + (size_t)piece * TEMPORARIES + below(tape, TEMPORARIES);
}

/* One that it may read: given, or computed once or by this piece; no piece leaves more to others. */
static uint16_t source(Tape *tape, int piece, size_t first_temporary) {
    const size_t at = below(tape, first_temporary + 2 * TEMPORARIES);
    const int own = at >= first_temporary + TEMPORARIES && piece > ONCE;
    return (uint16_t)(own ? at + (size_t)(piece - 1) * TEMPORARIES
                          : at % (first_temporary + TEMPORARIES));
}

const void *make_program(Tape *tape, const Counts *c, size_t *size) {
    const size_t n_constants = below(tape, MOST_CONSTANTS + 1), n_added = below(tape, 4);
    const size_t n_effective = (c->changes_inputs ? c->inputs : 0) + c->parameters;
    const size_t first_effective = 1 + c->states + c->inputs + c->coefficients + c->base;
    const size_t first_temporary = first_effective + n_effective + n_constants;
    const size_t n_registers = first_temporary + N_PIECES * TEMPORARIES;
    const size_t of_fmu = c->states - c->own; /* states */
    const size_t added = of_fmu > 0 ? n_added : 0, n_sites = added + c->own;
    uint32_t header[16] = {(uint32_t)n_registers, c->states, c->own, c->inputs, c->coefficients,
                           c->base, (uint32_t)n_constants, c->parameters, c->changes_inputs,
                           (uint32_t)n_sites, (uint32_t)added};
    size_t total = 8 + sizeof header + 8 * n_constants + 4 * n_sites;
    for (int piece = 0; piece < N_PIECES; piece++) {
        header[11 + piece] = 1 + (uint32_t)below(tape, MOST_INSTRUCTIONS);
        total += 8 * header[11 + piece];
    }
    uint8_t *const bytes = new_array(total, 1);
    Writer w = {bytes};
    put(&w, "CECORE1", 8);
    put(&w, header, sizeof header);
    for (size_t j = 0; j < n_constants; j++) {
        const double value = next_number(tape);
        put(&w, &value, sizeof value);
    }
    for (int piece = 0; piece < N_PIECES; piece++) {
        for (uint32_t j = 1; j < header[11 + piece]; j++) {
            Instruction i = {(uint16_t)(1 + below(tape, N_OPERATIONS - 1)), 0, 0, 0};
            i.to = (uint16_t)target(tape, c, piece, first_effective, first_temporary, n_effective);
            i.a = source(tape, piece, first_temporary), i.b = source(tape, piece, first_temporary);
            put(&w, &i, sizeof i);
        }
        const Instruction end = {END, 0, 0, 0};
        put(&w, &end, sizeof end);
    }
    for (size_t j = 0; j < n_sites; j++) {
        const Site s = {(uint16_t)(j < added ? below(tape, of_fmu) : of_fmu + j - added),
                        source(tape, AFTER, first_temporary)};
        put(&w, &s, sizeof s);
    }
    *size = total;
    return bytes;
}
