/* A heated room behind a heavy wall. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(C_room) > 0.0 && M(C_wall) > 0.0))
        return model_error(m, "heat capacities must be positive, got %g and %g", M(C_room),
                           M(C_wall));
    if (!(M(R_room_wall) > 0.0 && M(R_wall_out) > 0.0))
        return model_error(m, "thermal resistances must be positive, got %g and %g",
                           M(R_room_wall), M(R_wall_out));

    const double room_to_wall = (M(T_room) - M(T_wall)) / M(R_room_wall);
    const double wall_to_out = (M(T_wall) - M(T_out)) / M(R_wall_out);

    M(der_T_room) = (M(P) - room_to_wall) / M(C_room);
    M(der_T_wall) = (room_to_wall - wall_to_out) / M(C_wall);
    M(y) = M(T_room);
    return fmi2OK;
}
