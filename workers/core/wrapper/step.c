/* Co-simulation: from one communication point to the next. */
#include "wrapper.h"

/* Where inputs that are held jump, an original with events is told so by an event. */
static int jumped(const Instance *c) {
    if (!c->facts->eventful) return 0;
    for (int32_t j = 0; j < c->facts->n_inputs; j++) {
        const double was = c->was[j], is = c->seen[j];
        if (fabs(is - was) > 1e-9 * (fabs(is) + fabs(was))) return 1;
    }
    return 0;
}

/* The core's solvers, of an original for model exchange. */
RARELY static int integrate(Instance *c, int placed, int64_t *left) {
    Work *w = &c->work;
    if (c->now.in_event || jumped(c))
        TRY(handle_event_here(c));
    else if (!placed)
        TRY(set_at(w, 0, c->now.time, w->x));
    TRY(note_outputs(c));
    Stepping now = {c->now.time, c->now.proposed, *left};
    const int code = c->facts->fixed_steps ? equal_steps(w, 0, &now, NULL)
                                           : adaptive_steps(w, 0, &now, NULL);
    c->now.time = now.time, c->now.proposed = now.proposed, *left = now.left;
    TRY(explain(c, code));
    if (c->n_outer > 0) return set_at(w, 0, c->times[1], w->x); /* their effects see outputs */
    c->now.dirty |= MOVED;
    return OK;
}

/* The original's own steps. */
static int simulate(Instance *c, int placed, int64_t *left) {
    Work *w = &c->work;
    const double longest = c->settings.step;
    const int64_t steps = longest > 0.0 ? n_steps(*c->interval, longest, *left) : 1;
    if (steps > *left) return complain(c, ERROR, "a step takes too many steps");
    *left -= steps;
    if (!placed) {
        const Interval a = interval(&w->model, ANY, 0);
        TRY(set_effective(w, &a, c->now.time));
    }
    if (c->table.n_output_effects > 0) TRY(note_outputs(c));
    w->info.ended = 0;
    const int status = steps == 1 && !w->model.changes_inputs ? one_step(&w->model, ANY, w, 0)
                                                               : several_steps(w, 0, steps);
    c->now.ended = w->info.ended, c->now.reached = w->info.next_time;
    TRY(status);
    if (c->now.ended) return DISCARD;
    c->now.time = c->times[1];
    if (w->model.changes_inputs) c->now.dirty |= NEW_INPUTS;
    return OK;
}

FMI2(DoStep)(fmi2Component component, fmi2Real point, fmi2Real size, fmi2Boolean keeps) {
    Instance *c = component;
    const double end = point + size;
    /* where the original is; that of one's own steps has no time that could be another by rounding */
    int placed = c->now.dirty == 0
                 && (point == c->now.time || (!c->facts->exchange && !c->work.model.changes_inputs));
    int64_t left = c->settings.max_steps;
    (void)keeps;
    if (!c->simulates || c->now.phase != SIMULATING)
        return complain(c, ERROR, "fmi2DoStep must follow fmi2ExitInitializationMode");
    c->now.time = point;
    if (UNLIKELY(c->stale)) refresh(c);
    for (; c->now.time < end; placed = 0) {
        const double begin = c->now.time;
        c->times[1] = see_inputs(c, begin, end);
        *c->interval = c->times[1] - begin;
        c->now.dirty = 0;
        TRY(c->facts->exchange ? integrate(c, placed, &left) : simulate(c, placed, &left));
        if (c->times[1] == end || end - c->now.time <= time_resolution(end, end)) c->now.time = end;
        if (c->n_outer > 0) TRY(advance_outputs(c));
        pass_inputs(c, begin, c->now.time);
    }
    if (c->table.n_memories > 0) TRY(is_remembered(c));
    FOR(j, c->table.n_raw) c->slopes[j] = 0.0;
    return OK;
}

FMI2(SetRealInputDerivatives)(fmi2Component component, const fmi2ValueReference vr[], size_t n,
                              const fmi2Integer order[], const fmi2Real value[]) {
    Instance *c = component;
    for (size_t i = 0, j; i < n; i++) {
        for (j = 0; j < c->table.n_raw && c->table.raw[j] != vr[i]; j++) continue;
        if (j == c->table.n_raw || order[i] != 1)
            return complain(c, ERROR, "only first derivatives of continuous inputs can be set");
        c->slopes[j] = value[i];
    }
    return OK;
}

FMI2(GetRealOutputDerivatives)(fmi2Component component, const fmi2ValueReference vr[], size_t n,
                               const fmi2Integer order[], fmi2Real value[]) {
    (void)vr, (void)n, (void)order, (void)value;
    return complain(component, ERROR, "derivatives of outputs are not offered");
}

FMI2(CancelStep)(fmi2Component component) {
    return complain(component, ERROR, "no step goes on after fmi2DoStep has returned");
}

FMI2(GetStatus)(fmi2Component component, fmi2StatusKind kind, fmi2Status *value) {
    (void)kind, (void)value;
    return complain(component, DISCARD, "no step goes on after fmi2DoStep has returned");
}

FMI2(GetRealStatus)(fmi2Component component, fmi2StatusKind kind, fmi2Real *value) {
    Instance *c = component;
    if (kind != fmi2LastSuccessfulTime) return DISCARD;
    if (c->original.get_real_status != NULL && !c->facts->exchange)
        return ((GetStatus *)c->original.get_real_status)(c->original.f.handle, kind, value);
    *value = c->facts->exchange || !c->now.ended ? c->now.time : c->now.reached;
    return OK;
}

FMI2(GetBooleanStatus)(fmi2Component component, fmi2StatusKind kind, fmi2Boolean *value) {
    Instance *c = component;
    if (kind != fmi2Terminated) return DISCARD;
    if (c->original.get_boolean_status != NULL && !c->facts->exchange)
        return ((GetStatus *)c->original.get_boolean_status)(c->original.f.handle, kind, value);
    *value = c->now.ended != 0;
    return OK;
}

FMI2(GetIntegerStatus)(fmi2Component component, fmi2StatusKind kind, fmi2Integer *value) {
    (void)component, (void)kind, (void)value;
    return DISCARD;
}

FMI2(GetStringStatus)(fmi2Component component, fmi2StatusKind kind, fmi2String *value) {
    (void)component, (void)kind, (void)value;
    return DISCARD;
}
