/* The declarations of FMI 3.0.2 that callers of an original need (https://fmi-standard.org). */
#ifndef FMI3_H
#define FMI3_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef double fmi3Float64;
typedef bool fmi3Boolean;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;

typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean *, fmi3Float64 *);

typedef fmi3Instance fmi3InstantiateModelExchangeTYPE(fmi3String, fmi3String, fmi3String,
                                                      fmi3Boolean, fmi3Boolean,
                                                      fmi3InstanceEnvironment,
                                                      fmi3LogMessageCallback);
typedef fmi3Instance fmi3InstantiateCoSimulationTYPE(fmi3String, fmi3String, fmi3String,
                                                     fmi3Boolean, fmi3Boolean, fmi3Boolean,
                                                     fmi3Boolean, const fmi3ValueReference[],
                                                     size_t, fmi3InstanceEnvironment,
                                                     fmi3LogMessageCallback,
                                                     fmi3IntermediateUpdateCallback);
typedef void fmi3FreeInstanceTYPE(fmi3Instance);

/* Types of variables that are numbers: the standard's name, and C's. */
#define FMI3_NUMBERS(X)                                                                           \
    X(Float64, double) X(Float32, float) X(Int8, int8_t) X(UInt8, uint8_t) X(Int16, int16_t)      \
    X(UInt16, uint16_t) X(Int32, int32_t) X(UInt32, uint32_t) X(Int64, int64_t)                   \
    X(UInt64, uint64_t) X(Boolean, bool)

/* Functions of the standard: their names without "fmi3", and their arguments. */
#define FMI3_FUNCTIONS(X)                                                                         \
    X(SetDebugLogging, (fmi3Instance, fmi3Boolean, size_t, const fmi3String[]))                   \
    X(EnterConfigurationMode, (fmi3Instance))                                                     \
    X(ExitConfigurationMode, (fmi3Instance))                                                      \
    X(EnterInitializationMode, (fmi3Instance, fmi3Boolean, fmi3Float64, fmi3Float64, fmi3Boolean, \
                                fmi3Float64))                                                     \
    X(ExitInitializationMode, (fmi3Instance))                                                     \
    X(Terminate, (fmi3Instance))                                                                  \
    X(Reset, (fmi3Instance))                                                                      \
    X(GetString, (fmi3Instance, const fmi3ValueReference[], size_t, fmi3String[], size_t))        \
    X(SetString, (fmi3Instance, const fmi3ValueReference[], size_t, const fmi3String[], size_t))  \
    X(GetFMUState, (fmi3Instance, fmi3FMUState *))                                                \
    X(SetFMUState, (fmi3Instance, fmi3FMUState))                                                  \
    X(FreeFMUState, (fmi3Instance, fmi3FMUState *))                                               \
    X(SerializedFMUStateSize, (fmi3Instance, fmi3FMUState, size_t *))                             \
    X(SerializeFMUState, (fmi3Instance, fmi3FMUState, fmi3Byte[], size_t))                        \
    X(DeserializeFMUState, (fmi3Instance, const fmi3Byte[], size_t, fmi3FMUState *))              \
    X(GetDirectionalDerivative, (fmi3Instance, const fmi3ValueReference[], size_t,                \
                                 const fmi3ValueReference[], size_t, const fmi3Float64[], size_t, \
                                 fmi3Float64[], size_t))                                          \
    X(EnterEventMode, (fmi3Instance))                                                             \
    X(UpdateDiscreteStates, (fmi3Instance, fmi3Boolean *, fmi3Boolean *, fmi3Boolean *,           \
                             fmi3Boolean *, fmi3Boolean *, fmi3Float64 *))                        \
    X(EnterContinuousTimeMode, (fmi3Instance))                                                    \
    X(CompletedIntegratorStep, (fmi3Instance, fmi3Boolean, fmi3Boolean *, fmi3Boolean *))         \
    X(SetTime, (fmi3Instance, fmi3Float64))                                                       \
    X(SetContinuousStates, (fmi3Instance, const fmi3Float64[], size_t))                           \
    X(GetContinuousStateDerivatives, (fmi3Instance, fmi3Float64[], size_t))                       \
    X(GetEventIndicators, (fmi3Instance, fmi3Float64[], size_t))                                  \
    X(GetContinuousStates, (fmi3Instance, fmi3Float64[], size_t))                                 \
    X(GetNominalsOfContinuousStates, (fmi3Instance, fmi3Float64[], size_t))                       \
    X(DoStep, (fmi3Instance, fmi3Float64, fmi3Float64, fmi3Boolean, fmi3Boolean *, fmi3Boolean *, \
               fmi3Boolean *, fmi3Float64 *))

#endif
