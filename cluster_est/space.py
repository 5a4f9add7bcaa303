"""The place of `Space` in version 0.1; goes with the next one."""

import warnings

from cluster_est.problem.search_space.space import SearchSpace as Space

__all__ = ["Space"]

warnings.warn(
    "cluster_est.space: Space is called SearchSpace now and stands in "
    "cluster_est.problem.search_space.space; import it from there",
    DeprecationWarning,
    stacklevel=2,
)
