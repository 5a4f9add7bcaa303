/* Values of an original of FMI 3.0, whose variables are of more types and may be arrays.
 *
 * Here each element is a variable of its own; the original is given and asked for whole arrays. */
#include "model.h"

#include <math.h>
#include <string.h>

#if ORIGINAL_FMI == 3
#include "original_fmi3.h"

typedef enum {
#define NAME(name, type) name,
    FMI3_NUMBERS(NAME)
#undef NAME
} Type;

/* What each type can hold, where integers of FMI 2.0 reach beyond it. */
static const struct { double low, high; } ranges[] = {
    [Float64] = {-HUGE_VAL, HUGE_VAL}, [Float32] = {-HUGE_VAL, HUGE_VAL}, [Int8] = {-128, 127},
    [UInt8] = {0, 255}, [Int16] = {-32768, 32767}, [UInt16] = {0, 65535},
    [Int32] = {-HUGE_VAL, HUGE_VAL}, [UInt32] = {0, HUGE_VAL}, [Int64] = {-HUGE_VAL, HUGE_VAL},
    [UInt64] = {0, HUGE_VAL}, [Boolean] = {-HUGE_VAL, HUGE_VAL}};

/* A variable whose elements have the references from `first` on, in FMI 2.0. Those of an array
 * that can be set are kept from `kept` on; else that is -1. */
typedef struct {
    fmi2ValueReference first;
    int size;
    Type type;
    fmi3ValueReference reference;
    int kept;
} Place;

/* All variables but scalar ones that keep their type and reference, in the order of `first`. */
static const Place places[N_PLACES + 1] = PLACES;

static fmi2Status complain_of(const Inner *o, const char *text) {
    const fmi2CallbackFunctions *to = o->callbacks;
    if (to->logger != NULL)
        to->logger(to->componentEnvironment, "", fmi2Error, "logStatusError", "%s", text);
    return fmi2Error;
}

/* The variable that a reference of FMI 2.0 belongs to, or NULL if it is in no table. */
static const Place *find(fmi2ValueReference reference) {
    int low = 0, high = N_PLACES;
    while (low < high) {
        int middle = (low + high) / 2;
        if (places[middle].first <= reference)
            low = middle + 1;
        else
            high = middle;
    }
    if (low == 0 || reference - places[low - 1].first >= (fmi2ValueReference)places[low - 1].size)
        return NULL;
    return &places[low - 1];
}

/* The same, where scalars that are in no table are of the usual type. */
static Place place_of(fmi2ValueReference reference, Type usual) {
    const Place *found = find(reference);
    Place plain = {reference, 1, usual, reference, -1};
    return found == NULL ? plain : *found;
}

static int all_plain(const fmi2ValueReference vr[], size_t n) {
    size_t i = 0;
    if (N_PLACES == 0) return 1;
    while (i < n && find(vr[i]) == NULL) i++;
    return i == n;
}

/* A variable's elements from the original to `numbers`, and back. */
static fmi2Status read_numbers(Inner *o, const Place *place) {
    fmi3Status status = fmi3Error;
    int i;
    switch (place->type) {
#define READ(name, ctype)                                                                         \
    case name: {                                                                                  \
        const ctype *cells = o->cells;                                                            \
        if (o->Get##name == NULL) break;                                                          \
        status = o->Get##name(o->instance, &place->reference, 1, o->cells, place->size);          \
        for (i = 0; i < place->size && status < fmi3Discard; i++)                                 \
            o->numbers[i] = (double)cells[i];                                                     \
        break;                                                                                    \
    }
        FMI3_NUMBERS(READ)
#undef READ
    }
    return as_2(status);
}

static fmi2Status write_numbers(Inner *o, const Place *place) {
    fmi3Status status = fmi3Error;
    int i;
    for (i = 0; i < place->size; i++)
        if (o->numbers[i] < ranges[place->type].low || o->numbers[i] > ranges[place->type].high)
            return complain_of(o, "an integer is out of the range of its type in FMI 3.0");
    switch (place->type) {
#define WRITE(name, ctype)                                                                        \
    case name: {                                                                                  \
        ctype *cells = o->cells;                                                                  \
        for (i = 0; i < place->size; i++) cells[i] = (ctype)o->numbers[i];                        \
        if (o->Set##name != NULL)                                                                 \
            status = o->Set##name(o->instance, &place->reference, 1, o->cells, place->size);      \
        break;                                                                                    \
    }
        FMI3_NUMBERS(WRITE)
#undef WRITE
    }
    if (status < fmi3Discard && place->kept >= 0 && !o->kept->initialised)
        memcpy(o->kept->elements + place->kept, o->numbers, place->size * sizeof(double));
    return as_2(status);
}

/* What the elements of an array are that is to be set in part: nothing can be read at first. */
static fmi2Status recall(Inner *o, const Place *place) {
    if (o->kept->initialised || place->kept < 0) return read_numbers(o, place);
    memcpy(o->numbers, o->kept->elements + place->kept, place->size * sizeof(double));
    return fmi2OK;
}

static fmi2Status get_numbers(Inner *o, Type usual, const fmi2ValueReference vr[], size_t n,
                              void *values) {
    fmi2Status status = fmi2OK;
    Place place = {0, 0, usual, 0, -1};
    size_t i;
    for (i = 0; i < n; i++) {
        double number;
        if (place.size == 0 || vr[i] - place.first >= (fmi2ValueReference)place.size) {
            place = place_of(vr[i], usual);
            status = read_numbers(o, &place);
        }
        if (status >= fmi2Discard) return status;
        number = o->numbers[vr[i] - place.first];
        if (usual == Float64)
            ((fmi2Real *)values)[i] = number;
        else if (number >= -2147483648.0 && number <= 2147483647.0)
            ((fmi2Integer *)values)[i] = (fmi2Integer)number;
        else
            return complain_of(o, "an integer is too large for FMI 2.0");
    }
    return status;
}

/* Elements of an array that follow each other are set together. */
static fmi2Status set_numbers(Inner *o, Type usual, const fmi2ValueReference vr[], size_t n,
                              const void *values) {
    fmi2Status status = fmi2OK;
    size_t i, j, count;
    for (i = 0; i < n && status < fmi2Discard; i += count) {
        Place place = place_of(vr[i], usual);
        size_t element = vr[i] - place.first, size = (size_t)place.size;
        for (count = 1; i + count < n && element + count < size; count++)
            if (vr[i + count] != vr[i] + count) break;
        if (count < size) status = recall(o, &place);
        for (j = 0; j < count; j++)
            o->numbers[element + j] = usual == Float64 ? ((const fmi2Real *)values)[i + j]
                                                       : ((const fmi2Integer *)values)[i + j];
        if (status < fmi2Discard) status = write_numbers(o, &place);
    }
    return status;
}

#define VALUES(name, usual)                                                                       \
    fmi2Status Get##name##_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,            \
                             fmi2##name values[]) {                                               \
        return get_numbers(c, usual, vr, n, values);                                              \
    }                                                                                             \
    fmi2Status Set##name##_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,            \
                             const fmi2##name values[]) {                                         \
        return set_numbers(c, usual, vr, n, values);                                              \
    }
VALUES(Integer, Int32)
VALUES(Boolean, Boolean)

fmi2Status GetReal_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                     fmi2Real values[]) {
    Inner *o = c;
    if (!all_plain(vr, n)) return get_numbers(o, Float64, vr, n, values);
    return as_2(o->GetFloat64(o->instance, vr, n, values, n));
}

fmi2Status SetReal_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                     const fmi2Real values[]) {
    Inner *o = c;
    if (!all_plain(vr, n)) return set_numbers(o, Float64, vr, n, values);
    return as_2(o->SetFloat64(o->instance, vr, n, values, n));
}

fmi2Status GetString_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       fmi2String values[]) {
    Inner *o = c;
    return as_2(o->GetString(o->instance, vr, n, values, n));
}

fmi2Status SetString_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2String values[]) {
    Inner *o = c;
    return as_2(o->SetString(o->instance, vr, n, values, n));
}

fmi2Status GetDirectionalDerivative_2(fmi2Component c, const fmi2ValueReference unknown[],
                                      size_t unknowns, const fmi2ValueReference known[],
                                      size_t knowns, const fmi2Real seed[],
                                      fmi2Real result[]) {
    Inner *o = c;
    if (!all_plain(unknown, unknowns) || !all_plain(known, knowns))
        return complain_of(o, "no directional derivatives are to be had of elements of arrays");
    return as_2(o->GetDirectionalDerivative(o->instance, unknown, unknowns, known, knowns, seed,
                                            knowns, result, unknowns));
}

/* Set a structural parameter, which says how large arrays are. */
fmi2Status set_size(Inner *o, fmi2ValueReference reference, double value) {
    Place place = place_of(reference, UInt64);
    o->numbers[0] = value;
    return write_numbers(o, &place);
}
#endif
