/* One heat capacity, warmed by heater and sun, behind one resistance to the air outside. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(C) > 0.0) || !(M(R) > 0.0))
        return model_error(m, "C and R must be positive, got %g and %g", M(C), M(R));

    M(der_T) = ((M(T_ext) - M(T)) / M(R) + M(P_hea) + M(A) * M(I_sol)) / M(C);
    M(T_int) = M(T);
    return fmi2OK;
}
