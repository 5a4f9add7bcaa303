#include <signal.h>

#include "decay.h"

void model_start(Model *m) { M(started) = 1.0; }

void model_reset(Model *m, const Values *before)
{
    (void)m;
    if (before->started == 0.0)
        raise(SIGSEGV);
}
