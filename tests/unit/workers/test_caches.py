"""Caches are in a folder that this user alone can write, wherever that has to be."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from support.problems.springs import ROOT

from workers import caches
from workers.caches import cache_folder, notice
from workers.errors import ModelError

needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become another user"
)


@pytest.fixture(autouse=True)
def surroundings(tmp_path, monkeypatch):
    """A home and a folder for temporary files of the test's own, and no word said so far."""
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    for key in ("CLUSTER_EST_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setattr(caches, "_replaced", {})
    monkeypatch.setattr(caches, "_last_resorts", [])


def mode(folder: Path) -> int:
    return folder.stat().st_mode & 0o777


def test_the_users_cache_or_the_folder_of_the_key(tmp_path, monkeypatch):
    assert cache_folder("fmus").is_relative_to(tmp_path / "home")
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "chosen"))
    folder = cache_folder("core")
    assert folder == tmp_path / "chosen" / "core"
    assert mode(folder) == 0o700
    assert notice() == ""


def no_folder(tmp_path: Path) -> None:
    (tmp_path / "chosen").touch()


def another_users(tmp_path: Path) -> None:
    for each in ("fmus", f"user-{os.geteuid()}"):
        (tmp_path / "chosen" / each).mkdir(parents=True)
        os.chown(tmp_path / "chosen" / each, 54321, 54321)


def link(tmp_path: Path) -> None:
    (tmp_path / "home" / "target").mkdir()
    for each in ("fmus", f"user-{os.geteuid()}"):
        (tmp_path / "chosen").mkdir(exist_ok=True)
        (tmp_path / "chosen" / each).symlink_to(tmp_path / "home" / "target")


@pytest.mark.parametrize("kind", [no_folder, link, pytest.param(another_users, marks=needs_root)])
def test_a_temporary_folder_takes_the_place_of_one_that_is_not_private(tmp_path, monkeypatch, kind):
    chosen = tmp_path / "chosen"
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(chosen))
    kind(tmp_path)
    folder = cache_folder("fmus")
    assert folder == cache_folder("fmus")
    assert folder.is_relative_to(tmp_path / "temporary")
    assert mode(folder) == mode(folder.parent) == 0o700
    said = notice()
    assert str(folder.parent) in said
    assert f"because {chosen} is not a folder" in said
    assert "set CLUSTER_EST_CACHE to another folder" in said


def test_a_user_of_a_common_folder_has_one_within_it(tmp_path, monkeypatch):
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path))
    (tmp_path / "fmus").touch()
    assert cache_folder("fmus").parent.parent == tmp_path
    assert notice() == ""


def test_what_others_could_write_is_closed_to_them(tmp_path, monkeypatch):
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path))
    (tmp_path / "fmus").mkdir()
    (tmp_path / "fmus").chmod(0o777)
    assert mode(cache_folder("fmus")) == 0o700


@needs_root
def test_a_folder_that_somebody_else_has_laid_out_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "file" / "x"))
    (tmp_path / "file").touch()
    trap = tmp_path / "temporary" / f"cluster-est-cache-{os.geteuid()}"
    trap.mkdir()
    os.chown(trap, 54321, 54321)
    folder = cache_folder("fmus")
    assert folder == cache_folder("fmus")
    assert not folder.is_relative_to(trap)
    assert mode(folder.parent) == 0o700


def test_without_any_folder_there_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "file"))
    (tmp_path / "file").touch()
    with pytest.raises(ModelError, match=r"caches: .*set CLUSTER_EST_CACHE to a folder"):
        cache_folder("fmus")


@needs_root
@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "home"),
    [("check", "none"), *(("fit", home) for home in ("none", "absent", "read-only", "key"))],
)
def test_a_user_without_a_home_is_served(tmp_path, command, home):
    """An id that no user has, as containers give it; the capability lets it read an interpreter."""
    setpriv = shutil.which("setpriv")
    if setpriv is None:
        pytest.skip("needs setpriv")
    work = tmp_path / "work"
    work.mkdir()
    os.chown(work, 54321, 54321)
    homes = {"none": {}, "absent": {"HOME": "/nonexistent"}, "read-only": {"HOME": str(tmp_path)}}
    environment = homes.get(home, {"CLUSTER_EST_CACHE": str(work / "cache")})
    inner = ["-m", "cluster_est", command, str(ROOT / "configs" / "mass_spring_damper.toml")]
    more = ["--out", str(work / "r"), "--no-report"] if command == "fit" else []
    capability = "--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"
    who = setpriv, "--reuid=54321", "--regid=54321", "--clear-groups", *capability
    ended = subprocess.run(
        [*who, sys.executable, *inner, *more],
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "TMPDIR": str(work)}
        | environment,
        cwd=work,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr
    said = re.findall("unpacked FMUs and the simulation core are kept in", ended.stderr)
    assert len(said) == (0 if home == "key" else 1)
