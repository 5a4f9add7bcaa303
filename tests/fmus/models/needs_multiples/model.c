#include "decay.h"

double model_step_unit(void) { return 0.01; }
