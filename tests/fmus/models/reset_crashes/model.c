#include <signal.h>

#include "decay.h"

void model_reset(Model *m, const Values *before)
{
    (void)m, (void)before;
    raise(SIGSEGV);
}
