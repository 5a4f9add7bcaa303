/* Chua's circuit, dimensionless. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    const double x = M(x);
    const double resistor = M(b) * x + 0.5 * (M(a) - M(b)) * (fabs(x + 1.0) - fabs(x - 1.0));

    M(der_x) = M(alpha) * (M(y) - x - resistor);
    M(der_y) = x - M(y) + M(z);
    M(der_z) = -M(beta) * M(y);
    M(v1) = x;
    M(v2) = M(y);
    return fmi2OK;
}
