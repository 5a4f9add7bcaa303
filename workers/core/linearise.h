/* Derivatives by central differences at a time of the grid, for linearisations and filters. */
#ifndef LINEARISE_H
#define LINEARISE_H
#include "exchange.h"

/* Memory for the two ends of a difference: derivatives and outputs. */
typedef struct {
    const Linearisation *l;
    Work *w;
    Work *offsets; /* with the program that has an offset at each input; w itself without effects */
    double *dx[2], *y[2];
    void *memory;
} Differences;

/* The simulation of a batch's first point, and the same with offsets. */
typedef struct {
    Work work, with_offsets;
    Batch offsets;
    const Batch *batch;
    Differences d;
} Paired;

int begin_pair(Paired *p, const Batch *batch, const Linearisation *l);
/* Free all, and put the end into the batch; returns its code. */
int end_pair(Paired *p, End end);
/* All derivatives at grid time i, which the FMU is set to. Returns the status. */
int linearise_at(Differences *d, size_t i);
/* Simulate along the grid. At each time of it, `what` is done: it is given the FMU's outputs there,
 * may change the states, and returns the status. */
typedef int AtGridTime(Differences *d, size_t i, double time, const double *y, void *how);
End along_grid(Differences *d, AtGridTime *what, void *how);

#endif
