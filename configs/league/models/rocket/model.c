/* A body that is thrown upwards. */
#include "fmi2_model.h"

static const double GRAVITY = 9.81;

fmi2Status model_equations(Model *m)
{
    M(der_h) = M(v);
    M(der_v) = -GRAVITY;
    M(alt) = M(h);
    return fmi2OK;
}
