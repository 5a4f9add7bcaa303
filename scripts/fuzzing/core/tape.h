/* What a fuzzer gives, read as bytes and numbers; behind its end it begins anew. */
#ifndef TAPE_H
#define TAPE_H
#include <stddef.h>
#include <stdint.h>

typedef struct {
    const uint8_t *bytes;
    size_t size, at;
} Tape;

uint8_t next_byte(Tape *tape);
/* A whole number below n, which is at most 256. */
size_t below(Tape *tape, size_t n);
/* A small number, or one of those that surprise: not a number, infinite, huge, tiny, any bits. */
double next_number(Tape *tape);
/* One of several numbers. */
double one_of(Tape *tape, const double *numbers, size_t n);
#define ONE_OF(tape, ...)                                                          \
    one_of(tape, (const double[]){__VA_ARGS__},                                    \
           sizeof(const double[]){__VA_ARGS__} / sizeof(double))

/* Memory of exactly this size, so that a sanitizer sees what is read or written behind its end; all
 * of it is freed at once. */
void *new_array(size_t n, size_t size);
double *new_numbers(size_t n, Tape *filled_from); /* or not set, if that is NULL */
void free_arrays(void);

/* Say what must not be, and end the process. */
_Noreturn void found(const char *what);

/* Byte code that is sound, see program.h; returns its size. */
typedef struct {
    uint32_t states, own, inputs, coefficients, base, parameters, changes_inputs;
} Counts;
const void *make_program(Tape *tape, const Counts *counts, size_t *size);

#endif
