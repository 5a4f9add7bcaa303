"""Whether chains have mixed: their autocorrelation time, and how far their parts differ."""

from __future__ import annotations

import numpy as np

from workers.messages import FloatArray


def autocorrelation_times(chain: FloatArray) -> FloatArray:
    """Return the integrated autocorrelation time of each unknown, in steps.

    The mean of a chain of n steps of w walkers is as exact as that of w n / time independent draws
    (A. Sokal, in C. DeWitt-Morette et al., Functional Integration (1997),
    doi:10.1007/978-1-4899-0319-8_6).

    Parameters
    ----------
    chain : (steps, walkers, unknowns)

    Returns
    -------
    (unknowns,)
        At least 1; infinite for an unknown that some walker never moved.
    """
    from emcee.autocorr import integrated_time  # only a posterior needs it

    moves = (np.ptp(chain, axis=0) > 0.0).all(axis=0)
    times = np.full(chain.shape[2], np.inf)
    if moves.any() and len(chain) > 1:
        times[moves] = integrated_time(chain[:, :, moves], tol=0, quiet=True)
    return np.where(np.isnan(times), np.inf, np.maximum(times, 1.0))


def split_shrink_factors(chain: FloatArray) -> FloatArray:
    """Return by how much the spread of each unknown would shrink if the chains were longer.

    The potential scale reduction of split chains, sqrt(((n - 1) / n W + B / n) / W) with W the mean
    variance within the halves of all walkers and B / n that of their means (A. Gelman, D. B. Rubin,
    Stat. Sci. 7 (1992) 457-472, doi:10.1214/ss/1177011136; A. Vehtari et al., Bayesian Anal. 16
    (2021) 667-718, doi:10.1214/20-BA1221). 1 for chains that all tell the same.

    Parameters
    ----------
    chain : (steps, walkers, unknowns)

    Returns
    -------
    (unknowns,)
        Infinite for an unknown that never moved.
    """
    half = len(chain) // 2
    if half < 2:
        return np.full(chain.shape[2], np.inf)
    parts = np.concatenate([chain[:half], chain[len(chain) - half :]], axis=1)
    within = parts.var(axis=0, ddof=1).mean(axis=0)
    between = parts.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = np.sqrt(((half - 1) / half * within + between) / within)
    return np.where(np.isnan(factors), np.inf, factors)
