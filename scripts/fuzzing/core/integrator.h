/* CVODE for a batch, of the SUNDIALS 7 libraries in the folder that FUZZED_SUNDIALS names. */
#ifndef INTEGRATOR_H
#define INTEGRATOR_H
#include "core.h"

/* A new one for so many states, or NULL where there are no libraries. Each has an end. */
Cvode *new_cvode(size_t n_states);
void free_cvode(void);

#endif
