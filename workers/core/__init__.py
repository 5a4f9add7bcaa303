"""The core: simulation loops, effects and filters in C, called by ctypes.

`core.h` is its whole interface, `library` the same for Python, `build` says what is built for which
platforms and makes what is not carried along, `assemble` turns equations into byte code, `sundials`
makes CVODE's objects.

The C reads from the bottom to the top: `fmu.h` and `values` call an FMU by address; `program` and
`machine` run byte code; `work` has what all methods share; `co_simulation` stands on these alone.
`exchange` and `events` are for model exchange, and the methods `runge_kutta`, `dormand_prince` and
`cvode` stand on them; `batch` runs the loop of a method, `linearise`, `kalman` and `sensitivities`
stand on the methods. `outputs`, `memories` and `screening` need no FMU. `elementary` has the
functions whose bits are the same everywhere.
"""
