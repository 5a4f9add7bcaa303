#include "model.h"

static double simulations = 0.0;

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * (1.0 + 0.1 * M(started)) * M(x);
    M(y) = M(x);
    return OK;
}

void model_start(Model *m) { M(started) = simulations++; }
