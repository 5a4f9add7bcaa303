/* The modes of an instance, with the rules of the standard about who may enter them when. */
#include "core.h"

bool earlier(double a, double b) { return a < b - 1e-8 * (1.0 + fabs(b)); }

int core_set_up(Model *m, const char *function, double start, bool stop_defined, double stop)
{
    if (require(m, INSTANTIATED, function) != OK)
        return ERROR;
    if (stop_defined && !(stop > start))
        return error(m, "%s: the stop time %g is not after the start time %g", function, stop,
                     start);
    M(time) = start;
    m->state.stop = stop_defined ? stop : INFINITY;
    m->state.set_up = true;
    m->state.stale = true;
    return OK;
}

int core_enter_initialization(Model *m, const char *function)
{
    if (require(m, INSTANTIATED, function) != OK)
        return ERROR;
    if (!m->state.set_up)
        return error(m, "%s: the experiment has not been set up", function);
    m->state.phase = INITIALIZATION;
    return OK;
}

int settle(Model *m, const char *function)
{
    Event event;
    m->state.phase = EVENT_MODE;
    m->state.updating = true;
    for (int round = 0; m->state.updating && !m->state.ended; round++) {
        if (round == 1000)
            return error(m, "%s: the event iteration at %g does not end", function, M(time));
        if (core_update(m, function, &event) != OK)
            return ERROR;
    }
    m->state.phase = STEPPING;
    return OK;
}

int core_exit_initialization(Model *m, const char *function)
{
    if (require(m, INITIALIZATION, function) != OK)
        return ERROR;
    model_start(m);
    int status = refresh(m);
    if (status != OK) /* bad parameters are reported here, not in the first step */
        return status;
    m->state.last_event = M(time);
    m->state.phase = EVENT_MODE;
    m->state.updating = true;
    return m->co_simulation ? settle(m, function) : OK;
}

int core_enter_event_mode(Model *m, const char *function, unsigned from)
{
    if (require(m, from, function) != OK)
        return ERROR;
    m->state.phase = EVENT_MODE;
    m->state.updating = true;
    m->state.last_event = M(time);
    return OK;
}

int core_update(Model *m, const char *function, Event *event)
{
    *event = (Event){.next_time = INFINITY};
    if (require(m, EVENT_MODE, function) != OK)
        return ERROR;
    if (m->state.ended)
        return error(m, "%s: the model has asked for the end of the simulation", function);
    if (refresh(m) != OK)
        return ERROR;
    model_event(m, event);
    m->state.next_event = event->next_time;
    m->state.updating = event->again;
    m->state.ended = event->terminate;
    m->state.stale = true;
    return OK;
}

int core_enter_continuous_time(Model *m, const char *function)
{
    if (require(m, EVENT_MODE, function) != OK)
        return ERROR;
    if (m->state.ended)
        return error(m, "%s: the model has asked for the end of the simulation", function);
    if (m->state.updating)
        return error(m, "%s: the event iteration is not finished", function);
    m->state.phase = CONTINUOUS_TIME;
    return OK;
}

int core_completed_step(Model *m, const char *function, bool *enter_event_mode)
{
    if (require(m, CONTINUOUS_TIME, function) != OK)
        return ERROR;
    if (earlier(m->state.next_event, M(time)))
        return error(m, "%s: time %g is past the time event at %g", function, M(time),
                     m->state.next_event);
    if (earlier(m->state.stop, M(time)))
        return error(m, "%s: time %g is past the stop time %g", function, M(time),
                     m->state.stop);
    if (refresh(m) != OK)
        return ERROR;
    *enter_event_mode = model_step_completed(m);
    return OK;
}

int core_terminate(Model *m, const char *function)
{
    if (require(m, MODEL_EXCHANGE | STEPPING, function) != OK)
        return ERROR;
    m->state.phase = TERMINATED;
    return OK;
}

int core_set_time(Model *m, const char *function, double time)
{
    if (require(m, MODEL_EXCHANGE, function) != OK)
        return ERROR;
    if (!isfinite(time) || earlier(time, m->state.last_event))
        return error(m, "%s: time %g is before the last event at %g", function, time,
                     m->state.last_event);
    M(time) = time;
    m->state.stale = true;
    return OK;
}
