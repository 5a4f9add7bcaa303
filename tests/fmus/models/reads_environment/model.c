#include <stdlib.h>

#include "model.h"

static double gain = 1.0;

/* Called when the library is loaded. */
__attribute__((constructor)) static void read_environment(void)
{
    const char *text = getenv("GAIN_OF_THE_DECAY");
    if (text != NULL)
        gain = atof(text);
}

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = gain * M(x);
    return OK;
}
