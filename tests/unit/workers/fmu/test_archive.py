import hashlib
import io
import os
import random
import re
import stat
import struct
import zipfile

import pytest
from support.spoiled import LIBRARY, spoiled_fmu

from workers.errors import ModelError
from workers.fmu import archive
from workers.fmu.archive import open_archive, unpack

FMU = spoiled_fmu()
CHANCE = random.Random(1)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(folder))
    return folder


def refusal(content: bytes) -> str:
    with pytest.raises(ModelError) as error:
        unpack("x.fmu", content, hashlib.sha256(content).hexdigest())
    message = str(error.value)
    assert message.startswith("x.fmu: ")
    assert "\n" not in message
    return message


def with_member(name: str, content: bytes, mode: int = 0o644) -> bytes:
    """An archive of one entry."""
    file, entry = io.BytesIO(), zipfile.ZipInfo(name)
    entry.create_system, entry.external_attr = 3, mode << 16
    with zipfile.ZipFile(file, "w") as packed, packed.open(entry, "w") as opened:
        opened.write(content)
    return file.getvalue()


def flagged(content: bytes, offset: int, value: int) -> bytes:
    """Change a field of 16 bits in the first entry of the central directory."""
    first = content.index(b"PK\1\2") + offset
    return content[:first] + struct.pack("<H", value) + content[first + 2 :]


def test_an_fmu_is_unpacked_once(cache):
    folder = unpack("x.fmu", FMU, "some-hash")
    assert folder == cache / "fmus" / "some-hash"
    assert (folder / LIBRARY).is_file()
    assert unpack("x.fmu", b"not looked at", "some-hash") == folder
    assert os.listdir(folder.parent) == ["some-hash"]


DAMAGED = FMU[:200] + b"\xff" * 60 + FMU[260:]
CONFLICT = spoiled_fmu(lambda entries: entries.update({"a": b"", "a/b": b""}))
LINK = with_member("link", b"/etc/passwd", stat.S_IFLNK | 0o777)
METHOD = "cannot be unpacked (That compression method is not supported"
NO_ZIP = "must be an FMU, which is a zip file, but is not"
REFUSED = {
    "empty": (b"", NO_ZIP),
    "random": (CHANCE.randbytes(5000), NO_ZIP),
    "truncated": (FMU[:50_000], NO_ZIP),
    "damaged": (DAMAGED, ["cannot be unpacked (", "; export it again"]),
    "encrypted": (flagged(FMU, 8, 1), ["cannot be unpacked (", "encrypted"]),
    "unknown method": (flagged(FMU, 10, 77), METHOD),
    "other method": (flagged(FMU, 10, zipfile.ZIP_LZMA), "cannot be unpacked ("),
    "conflict": (CONFLICT, "cannot be unpacked into"),
    "no name": (with_member("", b"x"), "every entry in the FMU must have a name, but one has none"),
    "symbolic link": (LINK, "the path 'link' in it must stay inside"),
}
for name in (
    *("../evil", "a/../../evil", "/evil", "//evil", "C:/evil", "C:evil", "C:\\evil"),
    *("..\\evil", "a\\..\\..\\evil", "\\evil"),
):
    hostile = spoiled_fmu(lambda entries, name=name: entries.update({name: b"x"}))
    said = f"the path {name!r} in it must stay inside the FMU's folder, but leaves it"
    REFUSED[name] = hostile, said


@pytest.mark.parametrize(("content", "sentence"), REFUSED.values(), ids=REFUSED)
def test_a_damaged_or_hostile_archive_is_refused(cache, content, sentence):
    message = refusal(content)
    for part in [sentence] if isinstance(sentence, str) else sentence:
        assert part in message
    assert [*cache.glob("fmus/*")] == []


def test_a_zip_bomb_is_refused_before_it_is_unpacked(cache):
    zeros = bytes(archive.HARMLESS_BYTES + 1)
    message = refusal(spoiled_fmu(lambda e: (e.clear(), e.update(zeros=zeros))))
    assert re.search(r"would grow from 0\.\d to 64 MiB, which is unusual for an FMU", message)
    assert [*cache.glob("fmus/*")] == []


def test_an_archive_that_unpacks_to_too_much_is_refused(cache, monkeypatch):
    monkeypatch.setattr(archive, "MAX_UNPACKED_BYTES", 1000)
    assert "nothing was unpacked, because it would grow" in refusal(FMU)


def replace_by_folder(file):
    file.unlink()
    (file / "within").mkdir(parents=True)


def redirect(file):
    file.rename(file.with_name("elsewhere"))
    file.symlink_to("elsewhere")


def give_away(file):
    if os.geteuid():
        pytest.skip("only root can give a file to another user")
    os.chown(file, 54321, 54321)


HARM = {
    "emptied": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "reversed": lambda file: file.write_bytes(file.read_bytes()[::-1]),
    "gone": lambda file: file.unlink(),
    **{each.__name__: each for each in (replace_by_folder, redirect, give_away)},
}


@pytest.mark.parametrize("harm", HARM.values(), ids=HARM)
def test_every_file_that_was_harmed_is_written_anew(cache, harm):
    folder = unpack("x.fmu", FMU, "some-hash")
    with open_archive("x.fmu", FMU) as opened:
        truth = {name: opened.read(name) for name in opened.namelist()}
    for name in truth:
        harm(folder / name)
    with (folder / LIBRARY).parent.joinpath("own.txt").open("w") as own:
        own.write("written by the FMU")
    assert unpack("x.fmu", FMU, "some-hash") == folder
    for name, content in truth.items():
        assert (folder / name).read_bytes() == content
        assert (folder / name).lstat().st_uid == os.geteuid()
        assert not (folder / name).is_symlink()
    assert (folder / LIBRARY).parent.joinpath("own.txt").is_file()


@pytest.mark.parametrize("kind", ["file", "link"])
def test_what_stands_in_the_place_of_the_folder_gives_way(cache, tmp_path, kind):
    folder = unpack("x.fmu", FMU, "some-hash")
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved") if kind == "link" else folder.touch()
    assert unpack("x.fmu", FMU, "some-hash") == folder
    assert (folder / LIBRARY).is_file()
    assert not folder.is_symlink()


def test_any_damage_is_met_with_a_sentence(cache):
    small = spoiled_fmu(lambda e: [e.pop(n) for n in list(e) if n != "modelDescription.xml"])
    for _ in range(80):
        content = bytearray(small)
        for _ in range(CHANCE.randint(1, 4)):
            content[CHANCE.randrange(len(content))] = CHANCE.randrange(256)
        try:
            with open_archive("x.fmu", bytes(content)) as opened:
                assert opened.namelist()
            unpack("x.fmu", bytes(content), hashlib.sha256(content).hexdigest())
        except ModelError as error:
            assert str(error).startswith("x.fmu: ")  # noqa: PT017
