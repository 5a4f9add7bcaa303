/* A lithium-ion cell as an equivalent circuit with one pair of resistor and capacitor. */
#include <math.h>

#include "fmi2_model.h"

/* Volts without load: nearly linear, a little steeper when full, and a fall when nearly empty. */
static double open_circuit(double soc)
{
    return 3.45 + 0.45 * soc + 0.25 * soc * soc * soc - 0.35 * exp(-18.0 * soc);
}

fmi2Status model_equations(Model *m)
{
    if (!(M(Q) > 0.0 && M(R1) > 0.0 && M(C1) > 0.0))
        return model_error(m, "Q, R1 and C1 must be positive, got %g, %g and %g", M(Q), M(R1),
                           M(C1));

    M(der_soc) = -M(current) / M(Q);
    M(der_v1) = (M(current) - M(v1) / M(R1)) / M(C1);
    M(voltage) = open_circuit(M(soc)) - M(R0) * M(current) - M(v1);
    return fmi2OK;
}
