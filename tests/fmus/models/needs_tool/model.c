#include "decay.h"

int model_accept(Model *m) { return error(m, "the tool that exported this model is not installed"); }
