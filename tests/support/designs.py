import tempfile
from pathlib import Path

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.config.limits_file import LimitsFile, read_limits


def limits_text(
    top: str = "", tail: str = "", *, name: str = "F", within: tuple[float, float] = (-8.0, 8.0),
    duration: object = 10.0, sample_time: float = 0.05, candidates: int = 24,
) -> str:  # fmt: skip
    """A file of limits for one input, with keys before them and tables behind them."""
    return (
        f"{top}\nduration = {duration}\nsample_time = {sample_time}\ncandidates = {candidates}\n"
        f"[inputs.{name}]\nlower = {within[0]}\nupper = {within[1]}\n{tail}\n"
    )


def read_text(text: str) -> LimitsFile:
    """Read limits as from a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "limits.toml"
        path.write_text(text, encoding="utf-8")
        return read_limits(path)


def design_of(result: ce.Result | ce.LoopResult, text: str):
    """Design from Python with the limits of a text."""
    wanted = read_text(text)
    return ce.design(result, wanted.limits, settings=wanted.settings)


def designed(run: Path, out: Path, text: str, *arguments: str) -> int:
    """Design by the command with the limits of a text, which stands beside the run."""
    limits = run.parent / "limits.toml"
    limits.write_text(text, encoding="utf-8")
    return main(["design", str(run), "--limits", str(limits), "--out", str(out), *arguments])
