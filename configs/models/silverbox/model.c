/* The linear part of the Silverbox, an electronic mass-spring-damper. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(m) > 0.0))
        return model_error(m, "mass must be positive, got %g", M(m));

    M(der_y) = M(v);
    M(der_v) = (M(V1) - M(k) * M(y) - M(d) * M(v)) / M(m);
    M(V2) = M(y);
    return fmi2OK;
}
