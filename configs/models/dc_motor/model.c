/* A DC motor with a stiff load. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(L) > 0.0 && M(J) > 0.0))
        return model_error(m, "inductance and inertia must be positive, got %g and %g", M(L), M(J));

    M(der_i) = (M(V) - M(R) * M(i) - M(K) * M(w)) / M(L);
    M(der_w) = (M(K) * M(i) - M(b) * M(w)) / M(J);
    M(current) = M(i);
    M(speed) = M(w);
    return fmi2OK;
}
