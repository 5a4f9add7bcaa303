#include "decay.h"

double model_longest_step(void) { return 0.011; }
