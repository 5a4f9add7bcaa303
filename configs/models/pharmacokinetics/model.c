/* A drug in the body: gut, plasma and tissue, fed by mouth and by infusion. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(volume) > 0.0 && M(tissue_volume) > 0.0))
        return model_error(m, "volumes must be positive, got %g and %g", M(volume),
                           M(tissue_volume));

    const double absorbed = M(k_a) * M(gut);
    const double exchanged = M(k_12) * M(central) - M(k_21) * M(tissue);

    M(der_gut) = M(oral) - absorbed;
    M(der_central) = M(infusion) + absorbed - exchanged - M(k_e) * M(central);
    M(der_tissue) = exchanged;
    M(plasma_level) = M(central) / M(volume);
    M(tissue_level) = M(tissue) / M(tissue_volume);
    return fmi2OK;
}
