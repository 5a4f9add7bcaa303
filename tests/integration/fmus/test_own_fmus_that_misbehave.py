"""Each test FMU that behaves badly does so in the way that its description says."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.fmi1 import FMICallException
from fmus.drive import Driven

Give = Callable[[str, int], Path]
Open = Callable[..., Driven]

pytestmark = pytest.mark.usefixtures("fmpy_prints")

BOTH = pytest.mark.parametrize("fmi", [2, 3])
STEP = 0.1


@pytest.fixture
def opened(own_fmu: Give, tmp_path: Path) -> Iterator[Open]:
    """Co-simulation instances of test models, which are freed when the test is over."""
    instances: list[Driven] = []

    def give(name: str, fmi: int) -> Driven:
        instances.append(Driven(own_fmu(name, fmi), "CoSimulation", tmp_path))
        return instances[-1]

    yield give
    for instance in instances:
        instance.close()


def simulated(driven: Driven) -> float:
    """The output after one step."""
    driven.initialize()
    driven.fmu.doStep(0.0, STEP)
    return float(driven.get("y"))


def run_alone(script: str, fmu: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """The script's end in a new process, which is told the archive and where to unpack it."""
    command = [sys.executable, "-c", script, str(fmu), str(folder)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@BOTH
def test_fails_to_reset(opened: Open, fmi: int) -> None:
    driven = opened("fails_to_reset", fmi)
    fresh = simulated(driven)
    driven.fmu.reset()
    assert simulated(driven) == fresh

    driven.fmu.reset()
    driven.set("k", 2.0)
    driven.fmu.reset()
    assert simulated(driven) < fresh


@BOTH
def test_reset_keeps_state(opened: Open, fmi: int) -> None:
    driven = opened("reset_keeps_state", fmi)
    fresh = simulated(driven)
    driven.fmu.reset()

    assert simulated(driven) < fresh
    assert simulated(opened("reset_keeps_state", fmi)) == fresh


@BOTH
@pytest.mark.parametrize(
    ("name", "declared"), [("once_per_process", True), ("once_undeclared", False)]
)
def test_once_per_process(
    own_fmu: Give,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    fmi: int,
    name: str,
    declared: bool,
) -> None:
    first = Driven(own_fmu(name, fmi), "CoSimulation", tmp_path)
    assert first.description.coSimulation.canBeInstantiatedOnlyOncePerProcess == declared

    with pytest.raises(Exception, match="Failed to instantiate"):
        Driven(own_fmu(name, fmi), "CoSimulation", tmp_path)
    assert "can be instantiated only once in a process" in capsys.readouterr().out
    first.close()


@BOTH
@pytest.mark.parametrize("name", ["leaks", "leaks_on_reset"])
def test_leaks(own_fmu: Give, tmp_path: Path, fmi: int, name: str) -> None:
    # In a process of its own: what other tests freed would hold the leaks without any growth.
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from fmus.drive import Driven\n"
        "def simulate():\n"
        "    driven.initialize()\n"
        "    driven.fmu.doStep(0.0, 0.1)\n"
        "def resident():\n"
        "    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])\n"
        "    return pages * os.sysconf('SC_PAGE_SIZE')\n"
        "driven = Driven(Path(sys.argv[1]), 'CoSimulation', Path(sys.argv[2]))\n"
        "simulate()\n"
        "before = resident()\n"
        "for _ in range(40):\n"
        "    driven.fmu.reset()\n"
        "    simulate()\n"
        "print((resident() - before) / 2**20)\n"
    )

    growth = float(run_alone(script, own_fmu(name, fmi), tmp_path).stdout.split()[-1])

    assert growth > 36.0  # of 40 MiB, less what the process had free


@BOTH
def test_dead_parameter(opened: Open, fmi: int) -> None:
    driven = opened("dead_parameter", fmi)
    fresh = simulated(driven)
    driven.fmu.reset()
    driven.set("dead", 5.0)

    assert simulated(driven) == fresh


@BOTH
def test_random_output(opened: Open, fmi: int) -> None:
    driven = opened("random_output", fmi)
    found = set()
    for _ in range(5):
        found.add(simulated(driven))
        driven.fmu.reset()

    assert len(found) > 1


@BOTH
def test_slow(opened: Open, fmi: int) -> None:
    driven = opened("slow", fmi)
    driven.set("delay", 0.0)

    assert simulated(driven) == pytest.approx(0.904837, abs=1e-5)


@BOTH
def test_needs_library(opened: Open, fmi: int) -> None:
    with pytest.raises(Exception, match=r"libnobody_has_this\.so"):
        opened("needs_library", fmi)


def test_wrong_platform(own_fmu: Give, opened: Open) -> None:
    with pytest.raises(Exception, match="linux64"):
        opened("wrong_platform", 2)


@BOTH
def test_needs_tool(
    own_fmu: Give, opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    description = read_model_description(own_fmu("needs_tool", fmi))
    assert description.modelExchange.needsExecutionTool
    assert description.coSimulation.needsExecutionTool

    with pytest.raises(Exception, match="Failed to instantiate"):
        opened("needs_tool", fmi)
    assert "the tool that exported this model is not installed" in capsys.readouterr().out


@BOTH
def test_zero_directional(opened: Open, fmi: int) -> None:
    driven = opened("zero_directional", fmi)
    simulated(driven)
    pair = [driven.reference("der(x)"), driven.reference("y")], [driven.reference("x")]

    assert driven.fmu.getDirectionalDerivative(*pair, [1.0]) == [0.0, 0.0]


@BOTH
def test_wrong_directional(opened: Open, fmi: int) -> None:
    driven = opened("wrong_directional", fmi)
    simulated(driven)
    unknown, known = [driven.reference("der(x)")], [driven.reference("x"), driven.reference("u")]

    assert driven.fmu.getDirectionalDerivative(unknown, known, [1.0, 0.0]) == [-2.0]
    assert driven.fmu.getDirectionalDerivative(unknown, known, [0.0, 1.0]) == [2.0]


@BOTH
def test_no_licence(opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Exception, match="Failed to instantiate"):
        opened("no_licence", fmi)
    assert "licence checkout failed" in capsys.readouterr().out


@BOTH
def test_fixed_step(opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]) -> None:
    driven = opened("fixed_step", fmi)
    assert not driven.description.coSimulation.canHandleVariableCommunicationStepSize
    simulated(driven)

    with pytest.raises(FMICallException):
        driven.fmu.doStep(STEP, STEP / 2)
    assert "the step size must be 0.1, is 0.05" in capsys.readouterr().out


@BOTH
def test_hangs_at_start(own_fmu: Give, tmp_path: Path, fmi: int) -> None:
    script = (
        "import signal, sys\n"
        "from pathlib import Path\n"
        "from fmus.drive import Driven\n"
        "driven = Driven(Path(sys.argv[1]), 'CoSimulation', Path(sys.argv[2]))\n"
        "driven.enter_initialization()\n"
        "signal.setitimer(signal.ITIMER_REAL, 0.3)\n"
        "driven.fmu.exitInitializationMode()\n"
    )

    ended = run_alone(script, own_fmu("hangs_at_start", fmi), tmp_path)

    assert ended.returncode == -signal.SIGALRM


def test_invalid_xml(opened: Open) -> None:
    assert simulated(opened("invalid_xml", 2)) == pytest.approx(0.904837, abs=1e-6)
