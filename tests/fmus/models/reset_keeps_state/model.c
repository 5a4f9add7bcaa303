#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * (1.0 + 0.1 * M(runs)) * M(x);
    M(y) = M(x);
    return OK;
}

void model_reset(Model *m, const Values *before) { M(runs) = before->runs + 1.0; }
