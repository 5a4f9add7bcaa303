/* A resonant circuit: an inductor and a capacitor with a load, driven by an amplifier. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(L) > 0.0 && M(C) > 0.0))
        return model_error(m, "L and C must be positive, got %g and %g", M(L), M(C));

    M(der_i) = (M(e) - M(R) * M(i) - M(u)) / M(L);
    M(der_u) = (M(i) - M(G) * M(u)) / M(C);
    M(current) = M(i);
    M(voltage) = M(u);
    return fmi2OK;
}
