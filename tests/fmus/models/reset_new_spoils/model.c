#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(spoiled) != 0.0 ? 2.4e-322 : M(x);
    return OK;
}

void model_start(Model *m) { M(started) = 1.0; }

void model_reset(Model *m, const Values *before)
{
    M(spoiled) = before->started == 0.0 || before->spoiled != 0.0;
}
