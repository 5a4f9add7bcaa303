/* A heated core inside a case that gives its heat to the surroundings. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(C_core) > 0.0 && M(C_case) > 0.0))
        return model_error(m, "heat capacities must be positive, got %g and %g", M(C_core),
                           M(C_case));
    if (!(M(R_core_case) > 0.0 && M(R_case_ambient) > 0.0))
        return model_error(m, "thermal resistances must be positive, got %g and %g",
                           M(R_core_case), M(R_case_ambient));

    const double core_to_case = (M(T_core) - M(T_case)) / M(R_core_case);
    const double case_to_ambient = (M(T_case) - M(T_ambient)) / M(R_case_ambient);

    M(der_T_core) = (M(P) - core_to_case) / M(C_core);
    M(der_T_case) = (core_to_case - case_to_ambient) / M(C_case);
    M(y_core) = M(T_core);
    M(y_case) = M(T_case);
    return fmi2OK;
}
