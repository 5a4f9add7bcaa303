#include <time.h>

#include "decay.h"

bool model_step_completed(Model *m)
{
    const time_t seconds = (time_t)M(delay);
    struct timespec delay = {seconds, (long)(1e9 * (M(delay) - (double)seconds))};
    nanosleep(&delay, NULL);
    return false;
}
