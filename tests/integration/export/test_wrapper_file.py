"""The file that an exported FMU reads: whatever becomes of it, a message and no instance."""

import random
import shutil
import struct
import zlib

import pytest
from support.exported import Exported, repair_of, unpacked
from support.problems.driven_spring import driven, model_of
from support.sanitised_core import assert_nothing_is_found
from support.truth.springs_with_effects import FORCE, C, K, M

from cluster_est.model_export.repaired_fmu import TABLE
from workers.messages import Effect, Solver

EFFECTS = (
    Effect("late", "input F", "lag"),
    Effect("later", "input F", "delay"),
    Effect("drag", "der(v)", "quadratic"),
    Effect("slow", "output y", "lag"),
)
HEAD = 16
"""Bytes of the mark, the checksum and the length."""
TRIES = 60


@pytest.fixture(scope="module")
def spring(tmp_path_factory):
    repair = repair_of(
        model_of(Solver("dormand_prince")), driven(), (M, K, C), EFFECTS, (0.05, 0.013, 0.7, 0.04)
    )
    return unpacked(repair, tmp_path_factory.mktemp("spring"))


@pytest.fixture
def refused(spring, tmp_path):
    """Whether an FMU with this content in its file gives no instance, and what is said."""
    folder = tmp_path / "spoiled"
    shutil.copytree(spring, folder)

    def of(content):
        (folder / TABLE).write_bytes(content)
        said = []
        try:
            exported = Exported(folder, said=said)
        except Exception:  # of FMPy, which has no class for it
            return True, " ".join(said)
        exported.fmu.freeInstance()
        return False, " ".join(said)

    return of


def test_a_file_that_is_cut_or_changed_is_refused(spring, refused):
    whole = (spring / TABLE).read_bytes()
    assert refused(whole) == (False, "")
    dice = random.Random(1)
    lengths = {
        *range(0, 40, 3),
        *(dice.randrange(len(whole)) for _ in range(TRIES)),
        len(whole) - 1,
    }
    for content in (*(whole[:n] for n in lengths), whole + b"\0", *turned(whole, dice)):
        is_refused, said = refused(content)
        assert is_refused
        assert "repaired.bin is no file of this FMU: it is cut or was changed" in said


def turned(whole, dice):
    """The same with one bit of it turned."""
    for _ in range(TRIES):
        at = dice.randrange(len(whole))
        yield whole[:at] + bytes([whole[at] ^ 1 << dice.randrange(8)]) + whole[at + 1 :]


def test_a_file_that_is_forged_does_no_harm(spring, refused):
    """With a right checksum, but numbers that do not fit: an instance, or none and a message."""
    whole, dice = (spring / TABLE).read_bytes(), random.Random(2)
    outcomes = [refused(content) for content in forged(whole, dice)]
    assert {True, False} == {is_refused for is_refused, _ in outcomes}
    assert all(said for is_refused, said in outcomes if is_refused)


def forged(whole, dice):
    for _ in range(5 * TRIES):
        body = bytearray(whole[HEAD:])
        value = dice.choice((0, 1, 7, -1, 255, 65_536, 2**31 - 1, dice.randrange(2**31)))
        struct.pack_into("<i", body, 4 * dice.randrange(len(body) // 4), value)
        yield whole[:8] + struct.pack("<II", zlib.crc32(body), len(body)) + bytes(body)


def test_no_file_and_another_guid_are_said(spring, refused, tmp_path):
    whole = (spring / TABLE).read_bytes()
    guid = whole.index(b"{")
    other = b"{1" if whole[guid + 1 : guid + 2] == b"0" else b"{0"
    body = whole[HEAD:guid] + other + whole[guid + 2 :]
    is_refused, said = refused(whole[:8] + struct.pack("<II", zlib.crc32(body), len(body)) + body)
    assert is_refused
    assert f"the GUID must be {other.decode()}" in said


def test_a_neutral_coefficient_gives_the_bits_of_the_original(spring, tmp_path):
    """Each effect at its neutral value, over a grid of samples, and the FMU without effects."""
    model = model_of(Solver("rk4"))
    effects = (EFFECTS[2], Effect("gain", "output y", "gain"), Effect("more", "input F", "bias"))
    bits = []
    for number, (own, values) in enumerate((((), ()), (effects, (0.7, 1.3, 0.2)))):
        folder = tmp_path / str(number)
        folder.mkdir()
        exported = Exported(unpacked(repair_of(model, driven(), (M, K, C), own, values), folder))
        if own:
            for name, neutral in (("drag.k", 0.0), ("gain.k", 0.0), ("more.k", 0.0)):
                exported.set(name, neutral)
        exported.begin({"F": FORCE[0]})
        found = []
        for i, force in enumerate(FORCE[:100]):
            exported.drive("F", float(force), 0.5)
            found.append(exported.get("y"))
            exported.fmu.doStep(0.02 * i, 0.02)
        exported.close()
        bits.append(struct.pack(f"{len(found)}d", *found))
    assert bits[0] == bits[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "tests",
    [
        "tests/integration/export/test_wrapper_file.py",
        "tests/integration/export/test_exported_fmus.py",
        "tests/integration/export/test_exported_fmi3.py",
    ],
)
def test_sanitizers_find_nothing(tmp_path, tests):
    assert_nothing_is_found(tmp_path, "wrapper", tests)
