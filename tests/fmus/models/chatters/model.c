#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(down) ? -1.0 : 1.0;
    M(over_zero) = M(x);
    M(y) = M(x);
    return OK;
}

void model_event(Model *m, Event *event)
{
    (void)event;
    M(down) = M(x) > 0.0;
}
