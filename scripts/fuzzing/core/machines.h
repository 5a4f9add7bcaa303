/* Programs evaluated at one point, for tests. */
#ifndef MACHINES_H
#define MACHINES_H
#include "program.h"

enum { FAST, PLAIN };
/* `given` begins with time, states, inputs, coefficients and base values; `results` are effective
 * inputs, effective parameters and what derivatives are changed by, a value a site. */
void evaluate(const Program *p, int machine, const double *given, double *results);

#endif
