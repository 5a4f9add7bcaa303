#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(rate);
    M(y) = M(x);
    return OK;
}

bool model_step_completed(Model *m) { return M(x) >= 1.0; }

/* The part above 1 is kept, so the sawtooth does not depend on where the steps end. */
void model_event(Model *m, Event *event)
{
    if (M(x) < 1.0)
        return;
    M(x) -= 1.0;
    M(falls)++;
    event->states_changed = true;
}
