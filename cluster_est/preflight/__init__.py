"""What can be wrong with an FMU, a config or both, looked for before a fit.

`examine` is the recipe. A check is a function of a `CheckSubject` that returns `CheckFinding`s, and
an entry in `examine.CHECKS`; what it asks of the FMU is an `FmuProbe` in `workers`.
"""

from cluster_est.preflight.bare import bare_problem
from cluster_est.preflight.examine import SECONDS, examine
from cluster_est.preflight.findings import CheckFinding, CheckPage

__all__ = ["SECONDS", "CheckFinding", "CheckPage", "bare_problem", "examine"]
