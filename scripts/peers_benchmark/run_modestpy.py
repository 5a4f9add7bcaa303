"""Runs in modestpy's own environment: reads a case as JSON, prints what was found as JSON.

modestpy fits one record. Its own simulation is off in time by a part of a sample (at the true
values of a record without noise its error is not 0 but shrinks in proportion to the sampling
interval), so its minimum lies a little beside that of the others.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time

import pandas as pd
from modestpy import Estimation


def main() -> None:
    """Fit once; what a first call costs more is small beside the seconds of a fit."""
    case = json.load(sys.stdin)
    times = pd.Index(case["times"], name="time")
    bounds = zip(case["start"], case["lower"], case["upper"], strict=True)
    options = {"maxiter": 1000, "disp": False, "ftol": 1e-14}
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        session = Estimation(
            folder,
            case["fmu"],
            inp=pd.DataFrame({"F": case["force"]}, index=times),
            known=case["known"],
            est=dict(zip(case["unknowns"], bounds, strict=True)),
            ideal=pd.DataFrame({"y": case["measured"]}, index=times),
            methods=("SCIPY",),
            scipy_opts={"solver": "SLSQP", "options": options},
            ftype="RMSE",
            default_log=False,
        )
        values = session.estimate()
        seconds = time.perf_counter() - begin
    found = [float(values[name]) for name in case["unknowns"]]
    print(json.dumps({"values": found, "seconds": seconds, "simulations": None}))


if __name__ == "__main__":
    main()
