/* The way in: the loop of a method, for all points of a batch. */
#include "work.h"

size_t core_simulate(const Batch *batch) {
    switch (batch->method) {
    case CO_SIMULATION: return core_co_simulate(batch);
    case RUNGE_KUTTA: return core_runge_kutta(batch);
    case DORMAND_PRINCE: return core_dormand_prince(batch);
    default: return batch->n_states == 0 ? core_dormand_prince(batch) : core_cvode(batch);
    }
}
