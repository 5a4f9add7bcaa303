import re
import shutil
from itertools import product
from pathlib import Path

import pytest
from support.damages import KINDS, damaged
from support.run_folders import SPRING, facts_without_clocks, leave_as_killed, tables

from cluster_est.cli import main
from cluster_est.run_folder.log_segment import read_log

KEPT = ["log.keep_residuals=true", "budget.evaluations=60"]
CLOCK = re.compile(r"\d+\.\d+ s")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run(out) == 0
    return out


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


def run(out: Path, *arguments: str) -> int:
    return main(["fit", SPRING, "--out", str(out), "--no-report", *KEPT, *arguments])


def spoil(path: Path, kind: str, seed: int) -> None:
    path.write_bytes(damaged(path.read_bytes(), kind, seed))


COMMANDS = [
    ("parameters.parquet", ("show",)),
    ("searches.parquet", ("show", "--iterations")),
    ("residuals.parquet", ("report",)),
    ("config.toml", ("report",)),
    ("config.toml", ("replay", "3")),
    ("run.json", ("show",)),
    ("evaluations/00000.arrows", ("watch",)),
    ("evaluations/00000.arrows", ("show", "--failures")),
    ("evaluations/00000.arrows", ("replay", "3")),
]


@pytest.mark.parametrize(("file", "command"), COMMANDS)
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 12), marks=pytest.mark.slow)])
def test_who_reads_what_is_damaged_says_so_and_shows_nothing(
    file: str, command: tuple[str, ...], seeds: range, copy: Path, capsys: pytest.CaptureFixture
) -> None:
    """But where a damage has hit the text by which a checksum is known, and nothing else."""
    content, (name, *more) = (copy / file).read_bytes(), command
    assert main([name, str(copy), *more]) == 0
    good = capsys.readouterr().out
    for kind, seed in product(KINDS, seeds):
        (copy / file).write_bytes(damaged(content, kind, seed))
        code = main([name, str(copy), *more])
        said = capsys.readouterr()
        if code == 0:
            assert CLOCK.sub("", said.out) == CLOCK.sub("", good)
            continue
        assert code == 2
        assert file in said.err
        assert "is damaged" in said.err
        assert re.search("--resume|--overwrite", said.err)
        assert said.err.count("\n") == 1


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        *((kind, 0) for kind in KINDS),
        *(pytest.param(kind, seed, marks=pytest.mark.slow) for kind in KINDS for seed in (1, 2, 3)),
    ],
)
def test_a_resumed_run_has_the_bits_of_one_that_was_not_stopped(
    kind: str, seed: int, whole: Path, copy: Path, capsys: pytest.CaptureFixture
) -> None:
    leave_as_killed(copy)
    spoil(copy / "evaluations" / "00000.arrows", kind, seed)
    assert run(copy, "--resume") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert ("the log was damaged" in said) == (kind not in ("cut", "empty"))
    assert tables(copy) == tables(whole)
    assert facts_without_clocks(copy) == facts_without_clocks(whole)
    again = read_log(copy / "evaluations", ended=True)
    keys = [set(log["key"].to_pylist()) for log in (again, read_log(whole / "evaluations"))]
    assert keys[0] == keys[1]
    assert again.num_rows == read_log(whole / "evaluations").num_rows


@pytest.mark.parametrize("file", ["parameters.parquet", "config.toml", "evaluations/00000.arrows"])
def test_a_finished_run_of_which_something_is_damaged_is_mended_by_resuming_it(
    file: str, whole: Path, copy: Path
) -> None:
    spoil(copy / file, "empty", 0)
    assert run(copy, "--resume") == 0
    assert tables(copy) == tables(whole)
    assert main(["show", str(copy)]) == 0
    assert read_log(copy / "evaluations", ended=True).num_rows > 0


def test_a_table_without_its_end_is_said_in_one_line(copy: Path, capsys) -> None:
    """What Arrow says of a page of zeros there has two."""
    path = copy / "errors.parquet"
    content = path.read_bytes()
    path.write_bytes(bytes(len(content) - 8) + content[-8:])
    assert main(["show", str(copy)]) == 2
    said = capsys.readouterr().err
    assert "errors.parquet: is damaged" in said
    assert said.count("\n") == 1
