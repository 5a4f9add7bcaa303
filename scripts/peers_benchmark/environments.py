"""Other tools, each in a virtual environment of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from peers_benchmark.case import Case
from peers_benchmark.fmpy_fits import Fit

HERE = Path(__file__).parent
INSTALL_SECONDS, RUN_SECONDS = 900, 600


@dataclass(frozen=True)
class Tool:
    """A tool that does not share an environment with this project.

    Attributes
    ----------
    name
        Of the tool.
    requirements
        What pip installs; pinned, for the same figures next year.
    interfaces
        That it can be told to use.
    """

    name: str
    requirements: tuple[str, ...]
    interfaces: tuple[str, ...]

    def install(self, cache: Path) -> str:
        """Make its environment, once; why it cannot be had, or ""."""
        folder = cache / self.name
        stamp = folder / "installed.txt"
        wanted = "\n".join(self.requirements)
        if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
            return ""
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = [sys.executable, "-m", "venv", "--clear", str(folder)]
        pip = [str(python_of(folder)), "-m", "pip", "install", "--quiet", *self.requirements]
        for command in (made, pip):
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, timeout=INSTALL_SECONDS, check=False
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                return f"{self.name} does not install here ({error})"
            if done.returncode:
                return f"{self.name} does not install here ({last_line(done.stderr)})"
        stamp.write_text(wanted, encoding="utf-8")
        return ""

    def run(self, case: Case, cache: Path) -> Fit:
        """Fit the case's first record in a process of that environment."""
        python = python_of(cache / self.name)
        script = HERE / f"run_{self.name}.py"
        done = subprocess.run(
            [str(python), "-W", "ignore", str(script)],
            input=json.dumps(case.plain()),
            capture_output=True,
            text=True,
            timeout=RUN_SECONDS,
            cwd=cache,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{self.name} failed: {last_line(done.stderr)}")
        found = json.loads(last_line(done.stdout))
        return Fit(tuple(found["values"]), found["seconds"], found["simulations"])


TOOLS = (
    Tool("estim8", ("estim8==0.1.6",), ("co_simulation", "model_exchange")),
    # Of 2022: it needs what pandas 2 removed, and a module that later releases of pyDOE renamed.
    Tool(
        "modestpy",
        ("modestpy==0.1.1", "pandas<2", "numpy<2", "pyDOE<0.9", "fmpy<0.3.22"),
        ("co_simulation",),
    ),
)


def python_of(folder: Path) -> Path:
    """The interpreter of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def last_line(text: str) -> str:
    """The last line that says something."""
    return next((line for line in reversed(text.splitlines()) if line.strip()), "it said nothing")
