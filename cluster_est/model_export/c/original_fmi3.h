/* An original of FMI 3.0 behind the functions of FMI 2.0. */
#ifndef ORIGINAL_FMI3_H
#define ORIGINAL_FMI3_H

#include "fmi3.h"
#include "original.h"

/* An instance, and the functions of its library. */
typedef struct {
    fmi3Instance instance;
    const fmi2CallbackFunctions *callbacks;
    Kept *kept;
    double numbers[LARGEST]; /* the elements of a variable */
    void *cells;             /* the same in its own type */
    fmi3InstantiateModelExchangeTYPE *InstantiateModelExchange;
    fmi3InstantiateCoSimulationTYPE *InstantiateCoSimulation;
    fmi3FreeInstanceTYPE *FreeInstance;
#define FIELD(name, arguments) fmi3Status(*name) arguments;
    FMI3_FUNCTIONS(FIELD)
#undef FIELD
#define FIELD(name, type)                                                                         \
    fmi3Status (*Get##name)(fmi3Instance, const fmi3ValueReference[], size_t, type[], size_t);    \
    fmi3Status (*Set##name)(fmi3Instance, const fmi3ValueReference[], size_t, const type[], size_t);
    FMI3_NUMBERS(FIELD)
#undef FIELD
} Inner;

/* They are the same numbers. */
static inline fmi2Status as_2(fmi3Status status) { return (fmi2Status)status; }

/* values_fmi3.c: what FMI 2.0 calls fmi2GetReal is GetReal_2, and so on. */
fmi2Status set_size(Inner *o, fmi2ValueReference reference, double value);
#define VALUES(name)                                                                           \
    fmi2Status Get##name##_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,         \
                             fmi2##name values[]);                                             \
    fmi2Status Set##name##_2(fmi2Component c, const fmi2ValueReference vr[], size_t n,         \
                             const fmi2##name values[]);
VALUES(Real)
VALUES(Integer)
VALUES(Boolean)
VALUES(String)
#undef VALUES
fmi2Status GetDirectionalDerivative_2(fmi2Component c, const fmi2ValueReference unknown[],
                                      size_t unknowns, const fmi2ValueReference known[],
                                      size_t knowns, const fmi2Real seed[], fmi2Real result[]);

#endif
