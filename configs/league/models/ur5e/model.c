/* The current that a motor needs for the inertia and the viscous friction of its joint. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    M(i) = M(J) * M(qdd) + M(Fv) * M(qd);
    return fmi2OK;
}
