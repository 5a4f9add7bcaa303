#include <time.h>

#include "model.h"

int model_equations(Model *m)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(x) + M(noise) * (double)(now.tv_nsec % 1009) / 1009.0;
    return OK;
}
