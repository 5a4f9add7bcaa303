/* An exothermic reaction of first order in a cooled stirred tank. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(volume) > 0.0))
        return model_error(m, "volume must be positive, got %g", M(volume));
    if (!(M(T) > 0.0))
        return model_error(m, "temperature must be positive, got %g", M(T));

    const double renewal = M(flow) / M(volume);
    const double reaction = M(k_350) * exp(M(E_R) * (1.0 / 350.0 - 1.0 / M(T))) * M(c);

    M(der_c) = renewal * (M(c_feed) - M(c)) - reaction;
    M(der_T) = renewal * (M(T_feed) - M(T)) + M(rise) * reaction -
               M(cooling) * (M(T) - M(T_coolant));
    M(concentration) = M(c);
    M(temperature) = M(T);
    return fmi2OK;
}
