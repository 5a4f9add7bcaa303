"""The compiled loops behind `directions` and `adjoint`: one linear system, many at once."""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined, kernel


@kernel
def run_linear(keep, from_first, from_last, forcing, now, after):  # type: ignore[no-untyped-def]
    """Integrate x' = keep x + from_first f + from_last f' from x = 0, in place of the forcing.

    Parameters
    ----------
    keep, from_first, from_last : (n - 1, x, x)
        Of the step that begins at each time.
    forcing : (n, x, m)
        m right-hand sides; overwritten by the states.
    now, after : (x, m)
        Scratch.
    """
    _fill(now)
    for k in range(len(keep)):
        _fill(after)
        for i in range(len(now)):
            for j in range(len(now)):
                a, b, c = keep[k, i, j], from_first[k, i, j], from_last[k, i, j]
                for m in range(now.shape[1]):
                    after[i, m] += a * now[j, m] + b * forcing[k, j, m] + c * forcing[k + 1, j, m]
        _copy(now, forcing[k])
        _copy(after, now)
    _copy(now, forcing[len(keep)])


@kernel
def run_adjoint(keep, from_first, from_last, source, now, after):  # type: ignore[no-untyped-def]
    """Integrate the adjoint of `run_linear` backwards from 0, in place of the source.

    With l the adjoint state, l_k = keep_k' l_(k + 1) + source_k, and what a forcing f weighs with
    is from_first_k' l_(k + 1) + from_last_(k - 1)' l_k at time k.

    Parameters
    ----------
    keep, from_first, from_last : (n - 1, x, x)
        Of the step that begins at each time.
    source : (n, x, m)
        m weightings of the states; overwritten by the weights of a forcing.
    now, after : (x, m)
        Scratch.
    """
    last = len(keep)
    _copy(source[last], now)
    _fill(source[last])
    for k in range(last - 1, -1, -1):
        _copy(source[k], after)
        _fill(source[k])
        for i in range(len(now)):
            for j in range(len(now)):
                a, b, c = keep[k, i, j], from_first[k, i, j], from_last[k, i, j]
                for m in range(now.shape[1]):
                    after[j, m] += a * now[i, m]
                    source[k, j, m] += b * now[i, m]
                    source[k + 1, j, m] += c * now[i, m]
        _copy(after, now)


@inlined
def _fill(matrix):  # type: ignore[no-untyped-def]
    for i in range(matrix.shape[0]):
        for m in range(matrix.shape[1]):
            matrix[i, m] = 0.0


@inlined
def _copy(source, target):  # type: ignore[no-untyped-def]
    for i in range(source.shape[0]):
        for m in range(source.shape[1]):
            target[i, m] = source[i, m]
