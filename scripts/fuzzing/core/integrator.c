#include "integrator.h"

#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

#include "tape.h"

enum { CORE, VECTOR, MATRIX, LINEAR, INTEGRATOR, N_LIBRARIES, BACKWARD_DIFFERENCES = 2 };
static const char *const files[N_LIBRARIES] = {"core", "nvecserial", "sunmatrixdense",
                                               "sunlinsoldense", "cvode"};
static void *libraries[N_LIBRARIES];

/* Of one that is in use. */
static struct {
    Cvode cvode;
    void *context, *matrix, *solver;
} now;

static int are_loaded(void) {
    const char *const folder = getenv("FUZZED_SUNDIALS");
    if (folder == NULL || libraries[INTEGRATOR] != NULL) return folder != NULL;
    for (int j = 0; j < N_LIBRARIES; j++) {
        char path[4096];
        snprintf(path, sizeof path, "%s/sundials_%s.so", folder, files[j]);
        libraries[j] = dlopen(path, RTLD_NOW | RTLD_GLOBAL);
        if (libraries[j] == NULL) found(dlerror());
    }
    return 1;
}

static void *at(int library, const char *name) {
    void *const function = dlsym(libraries[library], name);
    if (function == NULL) found(name);
    return function;
}

/* Call a function that takes pointers (or a size) and returns one, or a number. */
#define CALL(type, library, name, ...) ((type)at(library, name))(__VA_ARGS__)
typedef void *OfOne(void *);
typedef int CreateContext(int, void **);
typedef void *MakeVector(int64_t, double *, void *);
typedef void *MakeMatrix(int64_t, int64_t, void *);
typedef void *MakeSolver(void *, void *, void *);
typedef void *MakeMemory(int, void *);
typedef int SetNumber(void *, int);
typedef int Init(void *, int (*)(double, void *, void *, void *), double, void *);
typedef int SetSolver(void *, void *, void *);

static Function integrator(const char *name) { return (Function)at(INTEGRATOR, name); }

Cvode *new_cvode(size_t n) {
    if (n == 0 || !are_loaded()) return NULL;
    const int64_t size = (int64_t)n;
    Cvode *const c = &now.cvode;
    CALL(CreateContext *, CORE, "SUNContext_Create", 0, &now.context);
    CALL(OfOne *, CORE, "SUNContext_ClearErrHandlers", now.context);
    double *const y = new_numbers(n, NULL), *const z = new_numbers(n, NULL);
    void *const memory = CALL(MakeMemory *, INTEGRATOR, "CVodeCreate", BACKWARD_DIFFERENCES,
                              now.context);
    *c = (Cvode){
        .memory = memory, .y = y, .z = z,
        .state_vector = CALL(MakeVector *, VECTOR, "N_VMake_Serial", size, y, now.context),
        .work_vector = CALL(MakeVector *, VECTOR, "N_VMake_Serial", size, z, now.context),
        .reinit = integrator("CVodeReInit"), .set_tolerances = integrator("CVodeSVtolerances"),
        .set_jacobian = integrator("CVodeSetJacFn"),
        .set_user_data = integrator("CVodeSetUserData"),
        .set_max_step = integrator("CVodeSetMaxStep"),
        .set_stop_time = integrator("CVodeSetStopTime"), .integrate = integrator("CVode"),
        .interpolate = integrator("CVodeGetDky"),
        .vector_data = (Function)at(CORE, "N_VGetArrayPointer"),
        .matrix_data = (Function)at(MATRIX, "SUNDenseMatrix_Data"),
    };
    now.matrix = CALL(MakeMatrix *, MATRIX, "SUNDenseMatrix", size, size, now.context);
    now.solver = CALL(MakeSolver *, LINEAR, "SUNLinSol_Dense", c->state_vector, now.matrix,
                      now.context);
    CALL(SetNumber *, INTEGRATOR, "CVodeSetMaxHnilWarns", memory, -1);
    CALL(Init *, INTEGRATOR, "CVodeInit", memory, core_right_hand_side, 0.0, c->state_vector);
    CALL(SetSolver *, INTEGRATOR, "CVodeSetLinearSolver", memory, now.solver, now.matrix);
    return c;
}

void free_cvode(void) {
    if (now.context == NULL) return;
    CALL(OfOne *, INTEGRATOR, "CVodeFree", &now.cvode.memory);
    CALL(OfOne *, CORE, "SUNLinSolFree", now.solver);
    CALL(OfOne *, CORE, "SUNMatDestroy", now.matrix);
    CALL(OfOne *, CORE, "N_VDestroy", now.cvode.state_vector);
    CALL(OfOne *, CORE, "N_VDestroy", now.cvode.work_vector);
    CALL(OfOne *, CORE, "SUNContext_Free", &now.context);
    now.context = NULL;
}
