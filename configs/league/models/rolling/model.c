/* A car that rolling resistance and the slope of the road slow down until it stands. */
#include "fmi2_model.h"

static const double GRAVITY = 9.81;
static const double STANDING = 0.02; /* m/s, below which what slows it down fades away */

fmi2Status model_equations(Model *m)
{
    const double moving = M(v) > 0.0 ? (M(v) < STANDING ? M(v) / STANDING : 1.0) : 0.0;

    M(der_v) = -GRAVITY * (M(crr) + M(dir) * M(slope)) * moving;
    M(speed) = M(v);
    return fmi2OK;
}
