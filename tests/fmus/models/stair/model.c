#include "model.h"

int model_equations(Model *m)
{
    M(y) = M(height) * M(counter);
    return OK;
}

void model_event(Model *m, Event *event)
{
    if (M(next) == 0.0) {
        M(next) = M(time) + 1.0;
    } else if (M(time) >= M(next) - 1e-9) {
        M(counter)++;
        M(next) += 1.0;
    }
    event->next_time = M(next);
    event->terminate = M(ends_at_10) && M(counter) >= 10;
}
