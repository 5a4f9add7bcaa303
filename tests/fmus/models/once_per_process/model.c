#include "decay.h"

/* Refuses for as long as the library stays loaded, even after the first instance was freed. */
int model_accept(Model *m)
{
    static bool taken = false;
    if (taken)
        return error(m, "this model can be instantiated only once in a process");
    taken = true;
    return OK;
}
