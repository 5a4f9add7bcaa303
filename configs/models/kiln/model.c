/* A kiln: a heated plate warms a charge, and both lose heat to their surroundings. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(C_plate) > 0.0 && M(C_charge) > 0.0))
        return model_error(m, "heat capacities must be positive, got %g and %g", M(C_plate),
                           M(C_charge));

    const double between = M(G_between) * (M(T_plate) - M(T_charge));
    const double plate_loss = M(G_plate) * (M(T_plate) - M(T_ambient));
    const double charge_loss = M(G_charge) * (M(T_charge) - M(T_ambient));

    M(der_T_plate) = (M(power) - between - plate_loss) / M(C_plate);
    M(der_T_charge) = (between - charge_loss) / M(C_charge);
    M(plate) = M(T_plate);
    M(charge) = M(T_charge);
    return fmi2OK;
}
