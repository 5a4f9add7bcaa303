/* The declarations of FMI 2.0.4 that the wrapper needs (https://fmi-standard.org). */
#ifndef FMI2_H
#define FMI2_H

#include <stddef.h>

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;

enum { fmi2False = 0, fmi2True = 1 };

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated }
    fmi2StatusKind;

typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

typedef struct {
    fmi2Boolean newDiscreteStatesNeeded;
    fmi2Boolean terminateSimulation;
    fmi2Boolean nominalsOfContinuousStatesChanged;
    fmi2Boolean valuesOfContinuousStatesChanged;
    fmi2Boolean nextEventTimeDefined;
    fmi2Real nextEventTime;
} fmi2EventInfo;

/* Every function of the standard: its name without "fmi2", and its arguments. */
#define FMI2_COMMON_FUNCTIONS(X)                                                                  \
    X(SetDebugLogging, (fmi2Component, fmi2Boolean, size_t, const fmi2String[]))                  \
    X(SetupExperiment, (fmi2Component, fmi2Boolean, fmi2Real, fmi2Real, fmi2Boolean, fmi2Real))   \
    X(EnterInitializationMode, (fmi2Component))                                                   \
    X(ExitInitializationMode, (fmi2Component))                                                    \
    X(Terminate, (fmi2Component))                                                                 \
    X(Reset, (fmi2Component))                                                                     \
    X(GetReal, (fmi2Component, const fmi2ValueReference[], size_t, fmi2Real[]))                   \
    X(GetInteger, (fmi2Component, const fmi2ValueReference[], size_t, fmi2Integer[]))             \
    X(GetBoolean, (fmi2Component, const fmi2ValueReference[], size_t, fmi2Boolean[]))             \
    X(GetString, (fmi2Component, const fmi2ValueReference[], size_t, fmi2String[]))               \
    X(SetReal, (fmi2Component, const fmi2ValueReference[], size_t, const fmi2Real[]))             \
    X(SetInteger, (fmi2Component, const fmi2ValueReference[], size_t, const fmi2Integer[]))       \
    X(SetBoolean, (fmi2Component, const fmi2ValueReference[], size_t, const fmi2Boolean[]))       \
    X(SetString, (fmi2Component, const fmi2ValueReference[], size_t, const fmi2String[]))         \
    X(GetFMUstate, (fmi2Component, fmi2FMUstate *))                                               \
    X(SetFMUstate, (fmi2Component, fmi2FMUstate))                                                 \
    X(FreeFMUstate, (fmi2Component, fmi2FMUstate *))                                              \
    X(SerializedFMUstateSize, (fmi2Component, fmi2FMUstate, size_t *))                            \
    X(SerializeFMUstate, (fmi2Component, fmi2FMUstate, fmi2Byte[], size_t))                       \
    X(DeSerializeFMUstate, (fmi2Component, const fmi2Byte[], size_t, fmi2FMUstate *))             \
    X(GetDirectionalDerivative, (fmi2Component, const fmi2ValueReference[], size_t,               \
                                 const fmi2ValueReference[], size_t, const fmi2Real[],            \
                                 fmi2Real[]))

#define FMI2_EXCHANGE_FUNCTIONS(X)                                                                \
    X(EnterEventMode, (fmi2Component))                                                            \
    X(NewDiscreteStates, (fmi2Component, fmi2EventInfo *))                                        \
    X(EnterContinuousTimeMode, (fmi2Component))                                                   \
    X(CompletedIntegratorStep, (fmi2Component, fmi2Boolean, fmi2Boolean *, fmi2Boolean *))        \
    X(SetTime, (fmi2Component, fmi2Real))                                                         \
    X(SetContinuousStates, (fmi2Component, const fmi2Real[], size_t))                             \
    X(GetDerivatives, (fmi2Component, fmi2Real[], size_t))                                        \
    X(GetEventIndicators, (fmi2Component, fmi2Real[], size_t))                                    \
    X(GetContinuousStates, (fmi2Component, fmi2Real[], size_t))                                   \
    X(GetNominalsOfContinuousStates, (fmi2Component, fmi2Real[], size_t))

#define FMI2_SIMULATION_FUNCTIONS(X)                                                              \
    X(SetRealInputDerivatives, (fmi2Component, const fmi2ValueReference[], size_t,                \
                                const fmi2Integer[], const fmi2Real[]))                           \
    X(GetRealOutputDerivatives, (fmi2Component, const fmi2ValueReference[], size_t,               \
                                 const fmi2Integer[], fmi2Real[]))                                \
    X(DoStep, (fmi2Component, fmi2Real, fmi2Real, fmi2Boolean))                                   \
    X(CancelStep, (fmi2Component))                                                                \
    X(GetStatus, (fmi2Component, fmi2StatusKind, fmi2Status *))                                   \
    X(GetRealStatus, (fmi2Component, fmi2StatusKind, fmi2Real *))                                 \
    X(GetIntegerStatus, (fmi2Component, fmi2StatusKind, fmi2Integer *))                           \
    X(GetBooleanStatus, (fmi2Component, fmi2StatusKind, fmi2Boolean *))                           \
    X(GetStringStatus, (fmi2Component, fmi2StatusKind, fmi2String *))

#define FMI2_FUNCTIONS(X)                                                                         \
    FMI2_COMMON_FUNCTIONS(X) FMI2_EXCHANGE_FUNCTIONS(X) FMI2_SIMULATION_FUNCTIONS(X)

typedef fmi2Component fmi2InstantiateTYPE(fmi2String, fmi2Type, fmi2String, fmi2String,
                                          const fmi2CallbackFunctions *, fmi2Boolean, fmi2Boolean);
typedef void fmi2FreeInstanceTYPE(fmi2Component);

#ifdef _WIN32
#define FMI2_EXPORT __declspec(dllexport)
#else
#define FMI2_EXPORT __attribute__((visibility("default")))
#endif

FMI2_EXPORT fmi2InstantiateTYPE fmi2Instantiate;
FMI2_EXPORT fmi2FreeInstanceTYPE fmi2FreeInstance;
FMI2_EXPORT const char *fmi2GetTypesPlatform(void);
FMI2_EXPORT const char *fmi2GetVersion(void);
#define DECLARE(name, arguments) FMI2_EXPORT fmi2Status fmi2##name arguments;
FMI2_FUNCTIONS(DECLARE)
#undef DECLARE

#endif
