"""Names of parts of a problem."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from cluster_est.errors import ProblemError
from workers.messages import Effect


def refuse_repeated(what: str, names: Sequence[str]) -> None:
    """Refuse a name that appears twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ProblemError(
            f"{what} {repeated[0]!r}: must appear once but appears twice; rename or remove one"
        )


def coefficient_names(effect: Effect) -> list[str]:
    """Names of an effect's coefficients."""
    from workers.effects.definition import coefficients  # SymPy takes long to import

    return [c.name for c in coefficients(effect, f"effect {effect.name!r}")]
