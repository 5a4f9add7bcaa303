/* The original FMU: its library, loaded from resources/original, and one instance of it. */
#ifndef ORIGINAL_H
#define ORIGINAL_H

#include "fmi2.h"

typedef struct {
    void *library;
    fmi2Component handle;
    fmi2InstantiateTYPE *Instantiate;
    fmi2FreeInstanceTYPE *FreeInstance;
#define FIELD(name, arguments) fmi2Status(*name) arguments;
    FMI2_FUNCTIONS(FIELD)
#undef FIELD
} Original;

/* Load the library and instantiate it. Returns 0, or -1 with a sentence in `why`. */
int original_load(Original *original, const char *resources, const char *name,
                  const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length);

/* Free the instance and the library; nothing if there is none. */
void original_free(Original *original);

#endif
