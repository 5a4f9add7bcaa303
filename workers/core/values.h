/* Numbers on their way into variables of an FMU, and back, whatever type the variables are of.
 *
 * A row of numbers is float64 throughout. Its first columns are float64 scalars, which one call
 * takes together; each other variable, and each array, has a call of its own.
 */
#ifndef VALUES_H
#define VALUES_H
#include "fmu.h"

/* The variables behind the float64 scalars; `buffer` has room for the largest of them. */
int set_elements(const Fmu *f, const Variables *v, const double *row, void *buffer);
int get_elements(const Fmu *f, const Variables *v, double *row, void *buffer);
/* The first variable of a row, whatever its value is. */
int get_first(const Fmu *f, const Variables *v, void *buffer);

ALWAYS int set_values(const Fmu *f, int fmi, const Variables *v, const double *row, void *buffer) {
    if (LIKELY(v->n_reals > 0)) TRY(set_reals(f, fmi, v->reals, v->n_reals, row));
    return LIKELY(v->n_elements == 0) ? OK : set_elements(f, v, row, buffer);
}

ALWAYS int get_values(const Fmu *f, int fmi, const Variables *v, double *row, void *buffer) {
    if (LIKELY(v->n_reals > 0)) TRY(get_reals(f, fmi, v->reals, v->n_reals, row));
    return LIKELY(v->n_elements == 0) ? OK : get_elements(f, v, row, buffer);
}

#endif
