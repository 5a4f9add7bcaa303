"""Runs in estim8's own environment: reads a case as JSON, prints what was found as JSON.

estim8 has no inputs (the force of this record is zero and is a parameter here), and its method
`local` starts in the given point only as an option that it hands to SciPy.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from estim8 import Estimator, datatypes, models


def main() -> None:
    """Fit twice, the first time to warm up."""
    case = json.load(sys.stdin)
    known = case["known"] | {"F": case["force"][0]}
    model = models.FmuModel(
        case["fmu"], fmi_type=case["interface"], default_parameters=known, r_tol=case["rtol"]
    )
    times, measured = np.array(case["times"]), np.array(case["measured"])
    measurement = datatypes.Measurement("y", times, measured, errors=np.ones_like(measured))
    data = datatypes.Experiment([measurement], observation_mapping={"y": "y"})
    bounds = zip(case["lower"], case["upper"], strict=True)
    estimator = Estimator(
        model=model,
        bounds={n: list(b) for n, b in zip(case["unknowns"], bounds, strict=True)},
        data=data,
        t=[times[0], times[-1], times[1] - times[0]],
        metric="SS",
    )
    for _ in range(2):
        begin = time.perf_counter()
        # SciPy's default tolerances stop L-BFGS-B while the cost is still 1e-8 too high or more
        options = {"x0": case["start"], "options": {"ftol": 1e-13, "gtol": 1e-10}}
        values, info = estimator.estimate(method="local", max_iter=1000, optimizer_kwargs=options)
        seconds = time.perf_counter() - begin
    found = [float(values[name]) for name in case["unknowns"]]
    print(json.dumps({"values": found, "seconds": seconds, "simulations": int(info.nfev)}))


if __name__ == "__main__":
    main()
