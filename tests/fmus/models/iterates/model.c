#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(rate);
    M(y) = M(x);
    return OK;
}

void model_event(Model *m, Event *event)
{
    if (M(next) == 0.0) {
        M(next) = M(time) + 1.0;
    } else if (M(left) == 0 && M(time) >= M(next) - 1e-9) {
        M(left) = M(rounds);
        M(next) += 1.0;
    }
    if (M(left) > 0) {
        M(x) += 1.0;
        M(left)--;
        event->states_changed = true;
    }
    event->again = M(left) > 0;
    event->next_time = M(next);
}
