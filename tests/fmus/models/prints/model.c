#include <stdio.h>

#include "model.h"

int model_equations(Model *m)
{
    printf("the equations at %g\n", M(time));
    fflush(stdout);
    M(der_x) = -M(k) * M(x);
    M(y) = M(x);
    return OK;
}
