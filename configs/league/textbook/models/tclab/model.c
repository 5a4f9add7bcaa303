/* Two heaters side by side, whose sensors follow them late. */
#include "fmi2_model.h"

static const double CAPACITY = 2.0; /* J/K, of each: only ratios to it can be seen */

fmi2Status model_equations(Model *m)
{
    if (!(M(tau) > 0.0))
        return model_error(m, "the time constant must be positive, got %g", M(tau));

    const double passed = M(Us) * (M(T2) - M(T1));

    M(der_T1) = (M(U) * (M(Ta1) - M(T1)) + passed + M(a1) * M(Q1)) / CAPACITY;
    M(der_T2) = (M(U) * (M(Ta2) - M(T2)) - passed + M(a2) * M(Q2)) / CAPACITY;
    M(der_S1) = (M(T1) - M(S1)) / M(tau);
    M(der_S2) = (M(T2) - M(S2)) / M(tau);
    M(TC1) = M(S1);
    M(TC2) = M(S2);
    return fmi2OK;
}
