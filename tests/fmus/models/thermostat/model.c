#include "model.h"

int model_equations(Model *m)
{
    M(der_T) = ((M(on) ? M(P) : 0.0) - M(G) * (M(T) - M(T_ambient))) / M(C);
    M(over_low) = M(T) - M(T_low);
    M(under_high) = M(T_high) - M(T);
    M(y) = M(T);
    return OK;
}

void model_event(Model *m, Event *event)
{
    (void)event;
    if (M(over_low) <= 0.0)
        M(on) = true;
    if (M(under_high) <= 0.0)
        M(on) = false;
}
