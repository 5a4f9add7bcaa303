"""What several tests share: a cache folder of their own, and FMUs built for tests."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import build_fmus
import fmpy
import pytest
from build_fmus import SCAFFOLD
from fmus import build as own
from hypothesis import settings

from cluster_est.running import reset_policy
from cluster_est.running.resources import one_blas_thread
from workers.caches import cache_folder as kept_for_good
from workers.core import build

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


@pytest.fixture(scope="session", autouse=True)
def blas_in_one_thread() -> Iterator[None]:
    """Sums round as in a fit, whatever number of cores there is."""
    with one_blas_thread():
        yield


class _Faults(logging.Handler):
    """Raises what a run would only note: a step after a search that failed by a fault."""

    def emit(self, record: logging.LogRecord) -> None:
        raise AssertionError(record.getMessage())


@pytest.fixture
def faults_are_noted() -> Iterator[None]:
    """A run goes on without a step that fails by a fault, as it does for a user."""
    log = logging.getLogger("cluster_est")
    handlers = list(log.handlers)
    log.handlers = [logging.NullHandler()]
    yield
    log.handlers = handlers


@pytest.fixture(scope="session", autouse=True)
def faults_are_raised() -> None:
    """A step after a search that fails by a fault fails the test, whatever that looks at."""
    logging.getLogger("cluster_est").addHandler(_Faults())


@pytest.fixture(scope="session", autouse=True)
def nobody_waits_for_the_next_second() -> None:
    """But for the test of an FMU that tells the time."""
    reset_policy.LATER_SECONDS = 0.0


@pytest.fixture(scope="session", autouse=True)
def interrupts_arrive() -> None:
    """Also where the tests run in the background of a shell, which has them ignored there."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Unpack FMUs into a folder of this session, not into the user's cache; the core is in both.

    They are looked for there by all processes that tests start.
    """
    core, folder = build.built(), tmp_path_factory.mktemp("cache")
    before = os.environ.get("CLUSTER_EST_CACHE")
    os.environ["CLUSTER_EST_CACHE"] = str(folder)
    shutil.copy(core, kept_for_good("core") / core.name)
    yield folder
    if before is None:
        del os.environ["CLUSTER_EST_CACHE"]
    else:
        os.environ["CLUSTER_EST_CACHE"] = before


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache folder of the test, with nothing but the core in it."""
    core = build.built()
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "cache"))
    shutil.copy(core, kept_for_good("core") / core.name)


@pytest.fixture(scope="session")
def kept_fmus(pytestconfig: pytest.Config) -> Path:
    """A folder for FMUs built from the sources as they are, for all processes and later runs."""
    if shutil.which("cc") is None or fmpy.platform != "linux64":
        pytest.skip("building with the system's compiler needs cc on a 64-bit Linux")
    own_folder, examples = Path(own.__file__).parent, SCAFFOLD
    sources = [build_fmus.__file__, *own_folder.rglob("*.*"), *examples.rglob("*.*")]
    texts = [Path(file).read_bytes() for file in sorted(map(str, sources)) if "pycache" not in file]
    texts.append(subprocess.run(["cc", "--version"], capture_output=True, check=True).stdout)
    digest = hashlib.sha256(b"\0".join(texts)).hexdigest()[:16]
    cache = pytestconfig.cache
    assert cache is not None
    return cache.mkdir(f"fmus-{digest}")


def _kept(path: Path, make: Callable[[Path], Path]) -> Path:
    """The file at this path, made if it is not there; two processes may make it at once."""
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            make(Path(folder)).replace(path)
    return path


@pytest.fixture(scope="session")
def built_fmu(kept_fmus: Path) -> Callable[[str], bytes]:
    """Give the FMU of a folder in `tests/fmus/lenient_models`, built once."""
    models = Path(__file__).parent / "fmus" / "lenient_models"

    def give(name: str) -> bytes:
        made = _kept(
            kept_fmus / f"{name}.fmu", lambda folder: build_fmus.build(models / name, folder)
        )
        return made.read_bytes()

    return give


@pytest.fixture(scope="session")
def own_fmu(kept_fmus: Path) -> Callable[[str, int], Path]:
    """Give a model of `tests/fmus/models` for a version of the FMI, built once."""

    def give(name: str, fmi: int) -> Path:
        path = kept_fmus / f"{name}_fmi{fmi}.fmu"
        return _kept(path, lambda folder: own.build(name, fmi, folder, "-O0"))

    return give


@pytest.fixture
def fmpy_prints() -> Iterator[None]:
    """What FMUs of FMI 2.0 say is printed, as fmpy does it, and not kept, as the project does.

    There is one logger for all of them in a process: that of whoever has asked last.
    """
    from ctypes import byref

    import fmpy.fmi2
    from fmpy.logging import addLoggerProxy

    import workers.fmu.instance

    theirs = fmpy.fmi2.fmi2CallbackFunctions()
    theirs.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(fmpy.fmi2.printLogMessage)
    addLoggerProxy(byref(theirs))
    yield
    workers.fmu.instance.CALLBACKS = workers.fmu.instance.make_callbacks()
