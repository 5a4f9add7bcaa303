/* The original FMU: its library, loaded from resources/original, and one instance of it. */
#ifndef ORIGINAL_H
#define ORIGINAL_H

#include "fmi2.h"
#include "model.h"

/* What callers of an original of FMI 3.0 keep between two calls. It is part of the FMU's state. */
typedef struct {
    int initialised;                 /* values can be read */
    double elements[N_ELEMENTS + 1]; /* those of arrays as they were set, until they can be read */
    fmi2Boolean tolerant, stops;     /* what fmi2SetupExperiment has said */
    double tolerance, start, stop;
    int ended;                       /* what the latest step has said */
    double reached;
} Kept;

/* The functions under the names of FMI 2.0, whichever version the original is of. */
typedef struct {
    void *library;
    fmi2Component handle;
    Kept *kept;
    fmi2InstantiateTYPE *Instantiate;
    fmi2FreeInstanceTYPE *FreeInstance;
#define FIELD(name, arguments) fmi2Status(*name) arguments;
    FMI2_FUNCTIONS(FIELD)
#undef FIELD
} Original;

/* Load the library and instantiate it. Returns 0, or -1 with a sentence in `why`. */
int original_load(Original *original, Kept *kept, const char *resources, const char *name,
                  const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length);

/* Begin again with what is kept, after a reset. */
void original_forget(Kept *kept);

/* Free the instance and the library; nothing if there is none. */
void original_free(Original *original);

/* For each version of FMI: fill in the functions of the library, and return the name of one that
 * every wrapper calls and it lacks, or NULL; then make the instance, or none. `resources` is as
 * that version has it. */
const char *original_bind(Original *original, void *look_up(void *library, const char *name));
void original_instantiate(Original *original, const char *name, const char *resources,
                          const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                          fmi2Boolean logging);

#endif
