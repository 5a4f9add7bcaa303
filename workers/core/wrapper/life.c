/* The life of an instance, and model exchange. */
#include <stdio.h>
#include <stdlib.h>

#include "wrapper.h"

#include "system.h"

FMI2_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI2_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

void say(const Instance *c, int status, const char *category, const char *text) {
    if (c->callbacks.logger != NULL)
        c->callbacks.logger(c->callbacks.componentEnvironment, c->name, status, category, "%s",
                            text);
}

/* Say what is wrong, and return the status. */
int complain(const Instance *c, int status, const char *text) {
    say(c, status, "logStatusError", text);
    return status;
}

/* ---- the life ---------------------------------------------------------------------------- */

/* Read what is in the resources; nothing of the original yet. */
static int read_table(Instance *c, const char *resources, const char *guid, char *why,
                      size_t length) {
    char *folder = path_of(resources);
    const size_t size = folder == NULL ? 0 : strlen(folder) + 32;
    char *path = folder == NULL ? NULL : malloc(size);
    const char *wrong = "there is no memory left";
    if (path != NULL) {
        snprintf(path, size, "%s/repaired.bin", folder);
        wrong = table_read(&c->table, path);
        if (wrong == NULL) wrong = make_instance(c);
        if (wrong != NULL) snprintf(why, length, "%s is no file of this FMU: %s", path, wrong);
    } else {
        snprintf(why, length, "%s", wrong);
    }
    free(folder);
    free(path);
    if (wrong == NULL && (guid == NULL || strcmp(guid, c->table.guid) != 0))
        snprintf(why, length, "the GUID must be %s but is another", c->table.guid);
    else if (wrong == NULL && !c->simulates && !c->facts->exchange)
        snprintf(why, length, "this FMU is for co-simulation alone, as its original");
    return why[0] == '\0' ? 0 : -1;
}

static int begin_life(Instance *c) {
    begin_again(c);
    TRY(configure(c));
    TRY(write_starts(c));
    return write_other_starts(c);
}

FMI2_EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                                          fmi2String resources,
                                          const fmi2CallbackFunctions *callbacks,
                                          fmi2Boolean visible, fmi2Boolean logging) {
    char why[1024] = "";
    if (callbacks == NULL) return NULL;
    if (name == NULL) name = "";
    if (resources == NULL) resources = "";
    Instance *c = calloc(1, sizeof *c);
    if (c == NULL) return NULL;
    c->callbacks = *callbacks;
    c->simulates = type == fmi2CoSimulation;
    c->name = malloc(strlen(name) + 1);
    if (c->name != NULL) {
        strcpy(c->name, name);
        if (read_table(c, resources, guid, why, sizeof why) == 0
            && original_load(c, resources, visible, logging, why, sizeof why) == 0) {
            c->work.model.f = c->original.f;
            if (begin_life(c) < DISCARD) return c;
            snprintf(why, sizeof why, "the original FMU does not take its start values");
        }
        say(c, ERROR, "logStatusError", why);
    }
    original_free(&c->original);
    free_instance(c);
    return NULL;
}

FMI2_EXPORT void fmi2FreeInstance(fmi2Component component) {
    Instance *c = component;
    if (c == NULL) return;
    original_free(&c->original);
    free_instance(c);
}

FMI2(SetDebugLogging)(fmi2Component component, fmi2Boolean on, size_t n,
                      const fmi2String categories[]) {
    const Instance *c = component;
    const Function f = c->original.set_debug_logging;
    void *const handle = c->original.f.handle;
    if (f == NULL) return OK;
    if (c->facts->version == 2)
        return ((int (*)(void *, int, size_t, const fmi2String *))f)(handle, on, n, categories);
    return ((int (*)(void *, uint8_t, size_t, const fmi2String *))f)(handle, on != 0, n,
                                                                     categories);
}

FMI2(SetupExperiment)(fmi2Component component, fmi2Boolean tolerant, fmi2Real tolerance,
                      fmi2Real start, fmi2Boolean stops, fmi2Real stop) {
    Instance *c = component;
    const double of_run = c->table.solver->tolerance;
    if (!c->facts->exchange && of_run > 0.0)
        tolerant = 1, tolerance = of_run;
    else if (c->facts->exchange && c->simulates)
        tolerant = 0;
    c->now.time = start;
    c->now.tolerant = tolerant, c->now.tolerance = tolerance, c->now.start = start;
    c->now.stops = stops, c->now.stop = stop;
    if (c->facts->version == 2)
        TRY(((SetUp *)c->original.f.setup_experiment)(c->original.f.handle, tolerant, tolerance,
                                                      start, stops, stop));
    return write_starts(c);
}

FMI2(EnterInitializationMode)(fmi2Component component) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    const Moment *now = &c->now;
    c->now.phase = INITIALISING;
    c->now.readable = 1;
    if (f->version == 2) return call(f->enter_initialization_mode, f->handle);
    return ((SetUp3 *)f->enter_initialization_mode)(f->handle, now->tolerant != 0, now->tolerance,
                                                    now->start, now->stops != 0, now->stop);
}

FMI2(ExitInitializationMode)(fmi2Component component) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    Work *w = &c->work;
    int status = OK;
    TRY(first_inputs(c));
    TRY(call(f->exit_initialization_mode, f->handle));
    c->now.phase = c->facts->exchange && !c->simulates ? EVENTS : SIMULATING;
    if (!c->facts->exchange) return begin(c);
    if (c->simulates) {
        const int code = iterate_event(w, &status);
        if (code != FINISHED) return explain(c, code);
        TRY(status);
    }
    if (f->n_states > 0) TRY(get_vector(f->get_continuous_states, f->handle, w->x, f->n_states));
    if (!c->simulates) return OK;
    TRY(begin(c));
    return store_event_indicators(w);
}

FMI2(Terminate)(fmi2Component component) {
    Instance *c = component;
    c->now.phase = ENDED;
    return call(c->original.terminate, c->original.f.handle);
}

FMI2(Reset)(fmi2Component component) {
    Instance *c = component;
    TRY(call(c->original.f.reset, c->original.f.handle));
    return begin_life(c);
}

/* ---- model exchange ---------------------------------------------------------------------- */

/* Refuse what only an FMU for model exchange has; `n` states or other numbers must be this many. */
static int check(const Instance *c, size_t n, size_t must) {
    if (!c->facts->exchange) return complain(c, ERROR, "this FMU is for co-simulation alone");
    return n == must ? OK : complain(c, ERROR, "the number of states is another");
}
#define CHECK(n, must) TRY(check(c, n, must))

FMI2(EnterEventMode)(fmi2Component component) {
    Instance *c = component;
    CHECK(0, 0);
    TRY(sync(c));
    c->now.phase = EVENTS;
    return call(c->original.f.enter_event_mode, c->original.f.handle);
}

FMI2(NewDiscreteStates)(fmi2Component component, fmi2EventInfo *info) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    EventInfo found = {0};
    CHECK(0, 0);
    TRY(sync(c));
    TRY(update_discrete_states(f, &found));
    *info = (fmi2EventInfo){found.update_needed, found.terminate, found.nominals_changed,
                            found.values_changed, found.next_defined, found.next_time};
    if (found.values_changed && f->n_states > 0)
        TRY(get_vector(f->get_continuous_states, f->handle, c->work.x, f->n_states));
    if (c->work.model.changes_inputs) c->now.dirty |= NEW_INPUTS;
    return OK;
}

FMI2(EnterContinuousTimeMode)(fmi2Component component) {
    Instance *c = component;
    CHECK(0, 0);
    TRY(sync(c));
    TRY(call(c->original.f.enter_continuous_time_mode, c->original.f.handle));
    c->now.phase = SIMULATING;
    TRY(begin(c));
    note_inputs(c);
    return OK;
}

FMI2(CompletedIntegratorStep)(fmi2Component component, fmi2Boolean keeps, fmi2Boolean *wants,
                              fmi2Boolean *ends) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    EventInfo info = {0};
    (void)keeps;
    CHECK(0, 0);
    TRY(sync(c));
    note_inputs(c);
    TRY(is_remembered(c));
    TRY(note_outputs(c));
    TRY(completed_integrator_step(f, f->version, &info));
    *wants = info.event_needed, *ends = info.ended;
    return OK;
}

FMI2(SetTime)(fmi2Component component, fmi2Real time) {
    Instance *c = component;
    CHECK(0, 0);
    c->now.time = time;
    if (c->work.model.changes_inputs || c->table.n_memories > 0) c->now.dirty |= NEW_INPUTS;
    return set_time(&c->original.f, time);
}

/* The FMU's states and those of the effects inside; behind them those of effects at outputs. */
FMI2(SetContinuousStates)(fmi2Component component, const fmi2Real x[], size_t n) {
    Instance *c = component;
    const size_t inner = c->table.n_nominals;
    CHECK(n, c->n_states);
    if (inner > 0) memcpy(c->work.x, x, inner * sizeof *x);
    if (c->n_outer > 0) memcpy(c->outer, x + inner, c->n_outer * sizeof *x);
    if (c->work.model.changes_inputs) c->now.dirty |= NEW_INPUTS;
    const Fmu *f = &c->original.f;
    return f->n_states > 0 ? set_continuous_states(f, x, f->n_states) : OK;
}

FMI2(GetContinuousStates)(fmi2Component component, fmi2Real x[], size_t n) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    const size_t inner = c->table.n_nominals;
    CHECK(n, c->n_states);
    if (inner > 0) memcpy(x, c->work.x, inner * sizeof *x);
    if (c->n_outer > 0) memcpy(x + inner, c->outer, c->n_outer * sizeof *x);
    return f->n_states > 0 ? get_vector(f->get_continuous_states, f->handle, x, f->n_states) : OK;
}

FMI2(GetDerivatives)(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    CHECK(n, c->n_states);
    return all_derivatives(c, result);
}

FMI2(GetEventIndicators)(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    CHECK(0, 0);
    TRY(sync(c));
    return get_vector(c->original.f.get_event_indicators, c->original.f.handle, result, n);
}

FMI2(GetNominalsOfContinuousStates)(fmi2Component component, fmi2Real result[], size_t n) {
    Instance *c = component;
    const Fmu *f = &c->original.f;
    CHECK(n, c->n_states);
    for (size_t j = f->n_states; j < n; j++) result[j] = 1.0;
    return f->n_states > 0 ? get_vector(f->get_nominals, f->handle, result, f->n_states) : OK;
}
