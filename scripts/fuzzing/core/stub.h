/* An FMU whose statuses and values come from a tape. It ends the process if it is called after it
 * has failed, or without end. */
#ifndef STUB_H
#define STUB_H
#include "core.h"
#include "tape.h"

typedef struct {
    int failure; /* 0; 3: only a reset may follow; 4: nothing may */
} Instance;

typedef struct {
    Tape *tape;
    int64_t calls, most_calls;
    int64_t fail_at; /* the number of the call that fails; < 0: none does */
    int fail_with, any_status, worst; /* any_status: each call's is from the tape */
} Stub;

extern Stub stub;
/* Start anew: functions for a version, with what the tape says it can. */
Fmu stub_fmu(Tape *tape, Instance *instance, int version, size_t n_states, size_t n_indicators);

#endif
