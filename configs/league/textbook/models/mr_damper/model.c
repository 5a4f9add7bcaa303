/* The dashpot of the base model with the hysteresis of Bouc and Wen beside it. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    const double dashpot = (M(c0) + M(c1) * M(I)) * M(v) + M(k) * M(x) + M(F0);
    const double strength = M(al0) + (M(al1) + M(al2) * M(I)) * M(I);
    const double full = pow(fabs(M(z)), M(n));
    const double against = fabs(M(v)) * copysign(full, M(z));

    M(der_z) = M(a) * (M(v) - M(g) * against - (1.0 - M(g)) * M(v) * full);
    M(F) = dashpot + strength * M(z);
    return fmi2OK;
}
