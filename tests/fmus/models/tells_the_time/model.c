#include <time.h>

#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(x) + 0.01 * (double)(time(NULL) % 997);
    return OK;
}
