/* Two heaters side by side: each loses heat to the air and to the other. */
#include "fmi2_model.h"

static const double CAPACITY = 2.0; /* J/K, of each: only ratios to it can be seen */

fmi2Status model_equations(Model *m)
{
    const double passed = M(Us) * (M(T2) - M(T1));

    M(der_T1) = (M(U) * (M(Ta1) - M(T1)) + passed + M(a1) * M(Q1)) / CAPACITY;
    M(der_T2) = (M(U) * (M(Ta2) - M(T2)) - passed + M(a2) * M(Q2)) / CAPACITY;
    M(TC1) = M(T1);
    M(TC2) = M(T2);
    return fmi2OK;
}
