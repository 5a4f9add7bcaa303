/* x'' = mu (1 - x^2) x' - x */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    M(der_x) = M(v);
    M(der_v) = M(mu) * (1.0 - M(x) * M(x)) * M(v) - M(x);
    M(y) = M(x);
    return fmi2OK;
}
