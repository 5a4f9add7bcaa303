"""The core's library: built once, and with a sentence where it cannot be."""

import ctypes
import re

import pytest

from workers.core import build, library
from workers.errors import ModelError


def test_it_is_built_once(tmp_path, monkeypatch):
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(build, "BINARIES", tmp_path)
    made = []

    def compiled(target, files):
        made.append(files)
        target.write_bytes(b"library")

    monkeypatch.setattr(build, "compile_to", compiled)
    assert not build.is_built()
    first = build.built()
    assert build.is_built()
    assert first.read_bytes() == b"library"
    assert build.built() == first
    assert len(made) == 1
    names = {path.name for path in first.parent.iterdir()}
    assert names == {first.name, f"{first.name}.sha256"}


def test_a_compiler_that_fails_is_quoted(tmp_path):
    wrong = tmp_path / "wrong.c"
    wrong.write_text("int main(")
    with pytest.raises(ModelError, match=r"(?s)cannot be built: .* says .*error"):
        build.compile_to(tmp_path / "wrong.so", [wrong])


def test_structures_are_those_of_the_header():
    """Their fields, in their order, and so their sizes."""
    text = re.sub(r"/\*.*?\*/", "", (build.HERE / "core.h").read_text(), flags=re.DOTALL)
    structures = [c for c in vars(library).values() if isinstance(c, type(ctypes.Structure))]
    structures = [c for c in structures if hasattr(c, "_fields_")]
    assert len(structures) == 13
    for structure in structures:
        body = re.search(r"typedef struct \{([^{}]*)\} " + structure.__name__ + ";", text)
        body = body or re.search(r"struct " + structure.__name__ + r" \{([^{}]*)\};", text)
        assert body is not None, structure
        names = re.sub(r"\[\w+\]", "", body[1]).replace("\n", " ")
        fields = [
            re.search(r"(\w+)\s*$", name.strip())[1]
            for statement in names.split(";")
            for name in statement.split(",")
            if name.strip()
        ]
        assert fields == [name for name, _ in structure._fields_], structure
