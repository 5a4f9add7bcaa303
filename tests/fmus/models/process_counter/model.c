#define _POSIX_C_SOURCE 200112L
#include "model.h"

#include <stdio.h>
#include <stdlib.h>

static const char *const NAME = "SIMULATIONS_OF_THE_PROCESS_COUNTER";

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * (1.0 + 0.1 * M(started)) * M(x);
    M(y) = M(x);
    return OK;
}

/* In the environment: static variables go when the library is unloaded with its last instance. */
void model_start(Model *m)
{
    const char *known = getenv(NAME);
    char text[32];

    M(started) = known != NULL ? atof(known) : 0.0;
    snprintf(text, sizeof text, "%g", M(started) + 1.0);
    setenv(NAME, text, 1);
}
