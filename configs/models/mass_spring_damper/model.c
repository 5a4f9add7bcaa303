/* A mass on a spring and a damper, driven by a force. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(m) > 0.0))
        return model_error(m, "mass must be positive, got %g", M(m));

    M(der_x) = M(v);
    M(der_v) = (M(F) - M(k) * M(x) - M(c) * M(v)) / M(m);
    M(y) = M(x);
    return fmi2OK;
}
