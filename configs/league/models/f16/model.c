/* One mode of vibration of a wing, and what follows the shaker's force at once. */
#include "fmi2_model.h"

static const double TURN = 6.283185307179586; /* rad */

fmi2Status model_equations(Model *m)
{
    const double w1 = TURN * M(f1);

    M(der_x1) = M(u1);
    M(der_u1) = M(F) - 2.0 * M(z1) * w1 * M(u1) - w1 * w1 * M(x1);
    M(a2) = M(r0) * M(F) + M(r1) * M(der_u1);
    return fmi2OK;
}
