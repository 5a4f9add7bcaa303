"""Charts as HTML with inline SVG, drawn without a library and without a network.

Read `chart.py` first: a `Chart` has plots below each other, a `Plot` has marks between two scales.
"""

from cluster_est.report.drawing.chart import Chart, Plot
from cluster_est.report.drawing.marks import (
    Band,
    Bars,
    Cells,
    Dots,
    ErrorBars,
    Line,
    Mark,
    Rules,
)
from cluster_est.report.drawing.scale import Scale

__all__ = [
    "Band",
    "Bars",
    "Cells",
    "Chart",
    "Dots",
    "ErrorBars",
    "Line",
    "Mark",
    "Plot",
    "Rules",
    "Scale",
]
