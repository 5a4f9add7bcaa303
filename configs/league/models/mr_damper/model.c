/* A damper whose fluid stiffens in the field of a coil: here no more than a dashpot. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    M(F) = (M(c0) + M(c1) * M(I)) * M(v) + M(k) * M(x) + M(F0);
    return fmi2OK;
}
