"""Every command by its name."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable

from cluster_est.cli.estimate import close_loop, fit, sweep
from cluster_est.cli.inspection import export, replay, report, show, watch
from cluster_est.cli.preparation import check, init
from cluster_est.cli.simulation import simulate

COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "init": init,
    "check": check,
    "fit": fit,
    "close-loop": close_loop,
    "simulate": simulate,
    "show": show,
    "report": report,
    "watch": watch,
    "export": export,
    "sweep": sweep,
    "replay": replay,
}
