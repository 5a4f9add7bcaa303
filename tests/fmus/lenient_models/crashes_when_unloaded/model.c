/* A decay that takes its process with it when its library is let go. */
#include <signal.h>

#include "fmi2_model.h"

__attribute__((destructor)) static void when_unloaded(void)
{
    raise(SIGSEGV);
}

fmi2Status model_equations(Model *m)
{
    M(der_x) = M(u) - M(rate) * M(x);
    M(y) = M(x);
    return fmi2OK;
}
