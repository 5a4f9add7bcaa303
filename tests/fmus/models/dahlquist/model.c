#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = -M(k) * M(x);
    M(y) = M(x);
    return OK;
}
