"""The options of all pattern searches."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Method
from cluster_est.methods.pattern_search.poll_directions import Axes, Basis
from cluster_est.problem.search_space.space import SearchSpace

SearchStep = Literal["none", "latin_hypercube", "quadratic"]


@dataclass(frozen=True)
class PatternMethod(Method):
    """A pattern search; `PatternSearch` says what the options mean."""

    needs_residuals: ClassVar[bool] = False
    needs_every_residual: ClassVar[bool] = False
    keeps_constraints: ClassVar[bool] = True

    basis: Basis = "2n"
    axes: Axes = "aligned"
    search_step: SearchStep = "quadratic"
    search_points: int = field(default=0, metadata={"least": 0})
    initial_mesh: float = field(default=0.25, metadata={"least": 1e-9})
    mesh_tolerance: float = field(default=1e-6, metadata={"least": 1e-10})
    expansion: float = field(default=2.0, metadata={"least": 1.0})
    contraction: float = field(default=0.5, metadata={"least": 0.01})
    max_iterations: int = field(default=1000, metadata={"least": 1})

    @override
    def check(self, space: SearchSpace) -> None:
        if not self.contraction < 1.0:
            raise ProblemError(
                f"method.options.contraction: must be below 1 but is {self.contraction:g}; 0.5 "
                "halves the mesh where no direction leads down"
            )
