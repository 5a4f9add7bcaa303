"""Checks of an FMU and a config before a fit.

`run_checks` runs them. A check is a function of a `CheckSubject` that returns `CheckFinding`s, and
an entry in `checks.CHECKS`; it asks the FMU with an `FmuProbe` of `workers`.
"""

from cluster_est.preflight.bare_fmu import bare_problem
from cluster_est.preflight.checks import SECONDS, run_checks
from cluster_est.preflight.measured_data import sigma_findings
from cluster_est.preflight.subject import CheckFinding, CheckPage, CheckVerdict

__all__ = [
    "SECONDS",
    "CheckFinding",
    "CheckPage",
    "CheckVerdict",
    "bare_problem",
    "run_checks",
    "sigma_findings",
]
