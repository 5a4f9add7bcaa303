"""The place of `read_log` in version 0.1; goes with the next one."""

import warnings

from cluster_est.run_folder.evaluation_log import read_log

__all__ = ["read_log"]

warnings.warn(
    "cluster_est.evaluation_log: read_log stands in cluster_est.run_folder.evaluation_log now; "
    "import it from there",
    DeprecationWarning,
    stacklevel=2,
)
