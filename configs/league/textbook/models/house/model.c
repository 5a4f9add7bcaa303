/* The heat of the air inside goes into the wall, and from the wall to the air outside. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(C) > 0.0) || !(M(Cw) > 0.0) || !(M(R) > 0.0) || !(M(Ri) > 0.0))
        return model_error(m, "capacities and resistances must be positive");

    const double to_air = (M(Tw) - M(T)) / M(Ri);

    M(der_T) = (to_air + M(P_hea) + M(A) * M(I_sol)) / M(C);
    M(der_Tw) = ((M(T_ext) - M(Tw)) / M(R) - to_air) / M(Cw);
    M(T_int) = M(T);
    return fmi2OK;
}
