"""Which unknowns can be estimated together: local sensitivities, collinearity, a subset.

S = J D: derivatives of the residuals by the unknowns, times a noticeable change of each. The size
of a column is how much the data see of an unknown; columns that are nearly dependent belong to
unknowns that can make up for each other. The collinearity index 1 / sqrt(smallest eigenvalue of
N'N), N the columns scaled to length 1, is how many times larger a change of the best combination is
than what is left of it: R. Brun, P. Reichert, H. R. Kuensch, Water Resour. Res. 37 (2001)
1015-1030, doi:10.1029/2000WR900350. The order is that of a QR decomposition with column pivoting:
M. Burth, G. C. Verghese, M. Velez-Reyes, IEEE Trans. Power Syst. 14 (1999) 218-225,
doi:10.1109/59.744536.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from workers.messages import FloatArray

INVISIBLE = 1e-9
"""Size of a column, over the largest, that counts as none: below it differences are rounding."""


@dataclass(frozen=True)
class IdentifiableUnknown:
    """An unknown, in the order in which they are best estimated.

    Attributes
    ----------
    unknown
        Its position in the space.
    size
        Root mean square of its scaled sensitivities, in sigmas.
    collinearity
        Index of this unknown with those before it that are estimated; infinite where it cannot be
        told from them.
    together
        It may be estimated together with them.
    """

    unknown: int
    size: float
    collinearity: float
    together: bool


def identifiable_order(
    jacobian: FloatArray, changes: FloatArray, most: float
) -> list[IdentifiableUnknown]:
    """Order unknowns by what the data see of each beyond those before it.

    Parameters
    ----------
    jacobian : (residuals, unknowns)
        At the point that they are judged at.
    changes : (unknowns,)
        A noticeable change of each.
    most
        Collinearity index from which on unknowns cannot be estimated together.
    """
    tall = jacobian * changes
    rows = max(len(tall), 1)
    # R of a QR decomposition has the columns' lengths and angles, and few rows
    scaled = np.linalg.qr(tall).R if len(tall) > tall.shape[1] else tall
    sizes = np.linalg.norm(scaled, axis=0)
    seen = sizes > INVISIBLE * sizes.max(initial=0.0)
    order = [] if not scaled.size else qr(scaled, mode="r", pivoting=True)[1].tolist()
    unit = scaled / np.where(seen, sizes, 1.0)
    found: list[IdentifiableUnknown] = []
    kept: list[int] = []
    for unknown in order:
        index = _collinearity(unit[:, [*kept, unknown]]) if seen[unknown] else np.inf
        together = index < most
        kept += [unknown] * together
        size = float(sizes[unknown] / np.sqrt(rows))
        found.append(IdentifiableUnknown(unknown, size, index, bool(together)))
    return found


def _collinearity(unit: FloatArray) -> float:
    """The index of columns of length 1."""
    smallest = float(np.linalg.svd(unit, compute_uv=False)[-1]) if len(unit) >= unit.shape[1] else 0
    return 1.0 / smallest if smallest > 0.0 else np.inf
