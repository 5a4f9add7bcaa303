#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(enabled) ? M(gain) * M(u) : 0.0;
    M(y) = M(x);
    return OK;
}
