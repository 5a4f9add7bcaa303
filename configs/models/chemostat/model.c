/* A chemostat: microbes that grow on a substrate, fed and drained at the same rate. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(K_s) > 0.0 && M(yield) > 0.0))
        return model_error(m, "K_s and yield must be positive, got %g and %g", M(K_s), M(yield));

    const double growth = M(mu_max) * M(S) / (M(K_s) + M(S)) * M(X);

    M(der_X) = growth - M(D) * M(X);
    M(der_S) = M(D) * (M(S_in) - M(S)) - growth / M(yield);
    M(biomass) = M(X);
    M(substrate) = M(S);
    return fmi2OK;
}
