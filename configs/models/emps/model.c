/* The carriage of an electro-mechanical positioning system. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(M) > 0.0))
        return model_error(m, "mass must be positive, got %g", M(M));

    M(der_q) = M(v);
    M(der_v) = (M(force) - M(Fv) * M(v)) / M(M);
    M(position) = M(q);
    M(velocity) = M(v);
    return fmi2OK;
}
