/* The functions of an original of FMI 2.0. */
#include "original.h"

#include <string.h>

#if ORIGINAL_FMI == 2
/* A function that the original lacks stays NULL. */
const char *original_bind(Original *original, void *look_up(void *library, const char *name)) {
    void *found;
#define FIND(name, arguments)                           \
    found = look_up(original->library, "fmi2" #name);   \
    memcpy(&original->name, &found, sizeof found);
    FIND(Instantiate, )
    FIND(FreeInstance, )
    FMI2_FUNCTIONS(FIND)
#undef FIND
    if (original->Instantiate == NULL || original->FreeInstance == NULL) return "fmi2Instantiate";
    if (original->GetReal == NULL || original->SetReal == NULL) return "fmi2SetReal";
    if (original->Reset == NULL) return "fmi2Reset";
#if ORIGINAL_EXCHANGE
    if (original->GetDerivatives == NULL && N_STATES > 0) return "fmi2GetDerivatives";
    if (original->NewDiscreteStates == NULL) return "fmi2NewDiscreteStates";
#else
    if (original->DoStep == NULL) return "fmi2DoStep";
#endif
    return NULL;
}

void original_instantiate(Original *original, const char *name, const char *resources,
                          const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                          fmi2Boolean logging) {
    original->handle = original->Instantiate(
        name, ORIGINAL_EXCHANGE ? fmi2ModelExchange : fmi2CoSimulation, ORIGINAL_GUID, resources,
        callbacks, visible, logging);
}

void original_forget(Kept *kept) { (void)kept; }
#endif
