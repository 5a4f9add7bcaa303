#include "values.h"

#include <string.h>

enum { FLOAT64, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, BOOLEAN };

/* Integers are converted by way of 64 bits, of which the lower ones are kept, as C compilers do for
 * numbers in range; others become the smallest number, where C would have no answer. */
static int64_t whole(double value) {
    const double limit = 9223372036854775808.0;
    return value >= -limit && value < limit ? (int64_t)value : INT64_MIN;
}

static uint64_t whole_unsigned(double value) {
    const double limit = 9223372036854775808.0;
    if (value >= limit && value < 2.0 * limit) return (uint64_t)value;
    return (uint64_t)whole(value);
}

static void put(void *buffer, int64_t e, const void *value, size_t size) {
    memcpy((char *)buffer + (size_t)e * size, value, size);
}

/* Write a number into element e of a variable; booleans are 0 or not. */
static void write_element(int fmi, int64_t type, double value, void *buffer, int64_t e) {
    const float single = (float)value;
    const int64_t i = whole(value);
    const uint64_t u = whole_unsigned(value);
    const int8_t i8 = (int8_t)i;
    const int16_t i16 = (int16_t)i;
    const int32_t i32 = (int32_t)i, boolean2 = value != 0.0;
    const uint8_t boolean3 = value != 0.0;
    switch (type) {
    case FLOAT64: put(buffer, e, &value, 8); break;
    case FLOAT32: put(buffer, e, &single, 4); break;
    case INT8:
    case UINT8: put(buffer, e, &i8, 1); break;
    case INT16:
    case UINT16: put(buffer, e, &i16, 2); break;
    case INT64: put(buffer, e, &i, 8); break;
    case UINT64: put(buffer, e, &u, 8); break;
    case BOOLEAN:
        if (fmi == 2)
            put(buffer, e, &boolean2, 4);
        else
            put(buffer, e, &boolean3, 1);
        break;
    default: put(buffer, e, &i32, 4); break;
    }
}

#define READ(number)                                                      \
    do {                                                                  \
        number value_;                                                    \
        memcpy(&value_, (char *)buffer + (size_t)e * sizeof value_, sizeof value_); \
        return (double)value_;                                            \
    } while (0)

static double read_element(int fmi, int64_t type, const void *buffer, int64_t e) {
    switch (type) {
    case FLOAT64: READ(double);
    case FLOAT32: READ(float);
    case INT8: READ(int8_t);
    case UINT8: READ(uint8_t);
    case INT16: READ(int16_t);
    case UINT16: READ(uint16_t);
    case UINT32: READ(uint32_t);
    case INT64: READ(int64_t);
    case UINT64: READ(uint64_t);
    case BOOLEAN:
        if (fmi == 3) READ(uint8_t);
        READ(int32_t);
    default: READ(int32_t);
    }
}

static int set_one(const Fmu *f, const Element *v, const void *values) {
    const uint32_t reference = (uint32_t)v->reference;
    const Function function = f->set[v->type];
    if (f->version == 2) return ((SetValues2 *)function)(f->handle, &reference, 1, values);
    return ((SetValues3 *)function)(f->handle, &reference, 1, values, (size_t)v->size);
}

static int get_one(const Fmu *f, const Element *v, void *values) {
    const uint32_t reference = (uint32_t)v->reference;
    const Function function = f->get[v->type];
    if (f->version == 2) return ((GetValues2 *)function)(f->handle, &reference, 1, values);
    return ((GetValues3 *)function)(f->handle, &reference, 1, values, (size_t)v->size);
}

int set_elements(const Fmu *f, const Variables *v, const double *row, void *buffer) {
    for (size_t first = 0; first < v->n_elements; first += (size_t)v->elements[first].size) {
        const Element *variable = v->elements + first;
        for (int64_t e = 0; e < variable->size; e++) {
            double value;
            if (variable[e].column < 0)
                memcpy(&value, &variable[e].bits, sizeof value);
            else
                value = row[variable[e].column];
            write_element(f->version, variable->type, value, buffer, e);
        }
        TRY(set_one(f, variable, buffer));
    }
    return OK;
}

int get_elements(const Fmu *f, const Variables *v, double *row, void *buffer) {
    for (size_t first = 0; first < v->n_elements; first += (size_t)v->elements[first].size) {
        const Element *variable = v->elements + first;
        TRY(get_one(f, variable, buffer));
        for (int64_t e = 0; e < variable->size; e++)
            if (variable[e].column >= 0)
                row[variable[e].column] = read_element(f->version, variable->type, buffer, e);
    }
    return OK;
}

int get_first(const Fmu *f, const Variables *v, void *buffer) {
    if (v->n_reals > 0) return get_reals(f, f->version, v->reals, 1, buffer);
    return v->n_elements > 0 ? get_one(f, v->elements, buffer) : OK;
}
