"""The core: simulation loops, effects and filters in C, called by ctypes.

`core.h` is its complete interface, and `library` is the same interface for Python. `build` lists
platforms and compiles missing libraries. `assemble` converts equations to byte code. `sundials`
creates the objects of CVODE.

The C files depend on each other in this order. `fmu.h` and `values` call an FMU by address;
`program` and `machine` run byte code; `work` is common to all methods. `co_simulation` needs only
these files. `exchange` and `events` are for model exchange, and the methods `runge_kutta`,
`dormand_prince` and `cvode` need them. `batch` runs the loop of a method. `linearise`, `kalman` and
`sensitivities` use the methods. `outputs`, `memories` and `screening` need no FMU. `elementary`
contains functions with bitwise identical results on all platforms.
"""
