/* A rod of twelve nodes, above the temperature of its surroundings; the eighth has a leak. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    M(der_T1) = M(conduction) * (M(T2) - 1.0 * M(T1)) - M(loss) * M(T1) + M(heating);
    M(der_T2) = M(conduction) * (M(T1) + M(T3) - 2.0 * M(T2)) - M(loss) * M(T2);
    M(der_T3) = M(conduction) * (M(T2) + M(T4) - 2.0 * M(T3)) - M(loss) * M(T3);
    M(der_T4) = M(conduction) * (M(T3) + M(T5) - 2.0 * M(T4)) - M(loss) * M(T4);
    M(der_T5) = M(conduction) * (M(T4) + M(T6) - 2.0 * M(T5)) - M(loss) * M(T5);
    M(der_T6) = M(conduction) * (M(T5) + M(T7) - 2.0 * M(T6)) - M(loss) * M(T6);
    M(der_T7) = M(conduction) * (M(T6) + M(T8) - 2.0 * M(T7)) - M(loss) * M(T7);
    M(der_T8) = M(conduction) * (M(T7) + M(T9) - 2.0 * M(T8)) - M(loss) * M(T8) - M(leak) * M(T8);
    M(der_T9) = M(conduction) * (M(T8) + M(T10) - 2.0 * M(T9)) - M(loss) * M(T9);
    M(der_T10) = M(conduction) * (M(T9) + M(T11) - 2.0 * M(T10)) - M(loss) * M(T10);
    M(der_T11) = M(conduction) * (M(T10) + M(T12) - 2.0 * M(T11)) - M(loss) * M(T11);
    M(der_T12) = M(conduction) * (M(T11) - 1.0 * M(T12)) - M(loss) * M(T12);
    M(y2) = M(T2);
    M(y5) = M(T5);
    M(y8) = M(T8);
    M(y11) = M(T11);
    return fmi2OK;
}
