"""Plots of a result with matplotlib; each uses the given axes, or new ones, and returns them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cluster_est.errors import ProblemError
from workers.fmu.description import nearest

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cluster_est.results.view import ResultView

MEASURED_STYLE: dict[str, Any] = {
    "color": "0.45",
    "marker": ".",
    "linestyle": "none",
    "markersize": 3.0,
}
BEFORE_STYLE: dict[str, Any] = {"color": "tab:orange", "linewidth": 1.0, "linestyle": "--"}
AFTER_STYLE: dict[str, Any] = {"color": "tab:blue", "linewidth": 1.5}


def new_axes(ax: Axes | None) -> Axes:
    """Return the given axes, or new ones.

    Raises
    ------
    ProblemError
        If matplotlib is not installed.
    """
    if ax is not None:
        return ax
    try:
        from matplotlib import pyplot
    except ImportError:
        raise ProblemError(
            "plot: needs matplotlib, which is not installed; run pip install 'cluster-est[plot]'"
        ) from None
    made: Axes = pyplot.subplots(layout="constrained")[1]
    return made


def plot_curves(
    view: ResultView, experiment: str | None, output: str | None, ax: Axes | None
) -> Axes:
    """Draw the measured and simulated values of one output; see `ResultView.plot`."""
    row = _chosen(view, experiment, output)
    ax = new_axes(ax)
    measured, simulated = (_part(view.table(name), row) for name in ("residuals", "trajectories"))
    ax.plot(measured["time"], measured["measured"], label="measured", **MEASURED_STYLE)
    if "simulated_before" in simulated and np.isfinite(simulated["simulated_before"]).any():
        ax.plot(simulated["time"], simulated["simulated_before"], label="before", **BEFORE_STYLE)
    ax.plot(simulated["time"], simulated["simulated"], label="simulated", **AFTER_STYLE)
    _name(ax, row, f"{row['output']} [{row['unit']}]" if row["unit"] else row["output"])
    ax.legend()
    return ax


def plot_residuals(
    view: ResultView, experiment: str | None, output: str | None, ax: Axes | None
) -> Axes:
    """Draw residuals over time; see `ResultView.plot_residuals`."""
    row = _chosen(view, experiment, output)
    ax = new_axes(ax)
    found = _part(view.table("residuals"), row)
    ax.axhline(0.0, color="0.8", linewidth=1.0)
    ax.plot(found["time"], found["residual"], **MEASURED_STYLE)
    _name(ax, row, f"(measured - simulated) / sigma of {row['output']}")
    return ax


def plot_correlation(view: ResultView, ax: Axes | None) -> Axes:
    """Draw correlations as coloured squares; see `ResultView.plot_correlation`."""
    ax, known = new_axes(ax), view.correlation
    image = ax.imshow(known.values, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    places = range(len(known.names))
    ax.set_xticks(places, known.names, rotation=90.0)
    ax.set_yticks(places, known.names)
    ax.figure.colorbar(image, ax=ax, label="correlation")
    return ax


def plot_profile(view: ResultView, label: str, ax: Axes | None) -> Axes:
    """Draw a likelihood profile; see `ResultView.plot_profile`."""
    rows = view.table("profiles").to_pylist() if "profiles" in view.tables else []
    labels = list(dict.fromkeys(row["label"] for row in rows))
    if label not in labels:
        asked = f"{nearest(label, labels)}" if labels else (
            f'; request it with fit(..., uncertainty={{"profiles": ["{label}"]}})'
        )  # fmt: skip
        raise ProblemError(f"plot_profile: this result has no profile of {label!r}{asked}")
    ax = new_axes(ax)
    own = [row for row in rows if row["label"] == row["unknown"] == label]
    ax.plot([row["value"] for row in own], [row["root"] for row in own], marker=".", **AFTER_STYLE)
    ends = next(r for r in view.table("intervals").to_pylist()
                if (r["label"], r["source"]) == (label, "profile"))  # fmt: skip
    for end in ("lower", "upper"):
        if np.isfinite(ends[end]):
            ax.axvline(ends[end], color="0.6", linestyle=":")
    unit = view.params[label].unit
    ax.set_xlabel(f"{label} [{unit}]" if unit else label)
    ax.set_ylabel("distance from the estimate [standard deviations]")
    ax.set_title(f"Profile of {label}, {100.0 * ends['confidence']:.4g} % interval")
    return ax


def _chosen(view: ResultView, experiment: str | None, output: str | None) -> Mapping[str, Any]:
    """Return the row of the chosen output; of several rows, that with the largest error."""
    rows = [row for row in view.table("errors").to_pylist() if not _is_curve(row)]
    for key, wanted in (("experiment", experiment), ("output", output)):
        known = list(dict.fromkeys(row[key] for row in rows))
        if wanted is not None and wanted not in known:
            raise ProblemError(
                f"plot: this result has no {key} {wanted!r}{nearest(str(wanted), known)}"
            )
        rows = [row for row in rows if wanted in (None, row[key])]
    if not rows:
        raise ProblemError("plot: this result has no output that was measured over time")
    return max(rows, key=lambda row: np.nan_to_num(row["normalised_after"], nan=-1.0))


def _is_curve(row: Mapping[str, Any]) -> bool:
    return str(row["output"]).startswith("curve of ")


def _part(table: pa.Table, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of one output of one experiment."""
    own = pc.equal(table["experiment"], row["experiment"])
    own = pc.and_(own, pc.equal(table["output"], row["output"]))
    part = table.filter(own)
    names = [
        name for name in part.column_names if pa.types.is_floating(part.schema.field(name).type)
    ]
    return {name: part[name].to_numpy() for name in names}


def _name(ax: Axes, row: Mapping[str, Any], quantity: str) -> None:
    held_out = ", held out" if row["role"] == "test" else ""
    ax.set_title(f"{row['experiment']}{held_out}")
    ax.set_xlabel("time [s]")
    ax.set_ylabel(quantity)
