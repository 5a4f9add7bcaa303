"""An FMU without a binary for this machine is answered with what it has instead."""

import pytest
from support.described import fmi2

from workers.errors import ModelError
from workers.fmu.platforms import PLATFORM, PLATFORM_TUPLE, binary_path, platform_for

HERE = binary_path("2.0", "m")


def refusal(*files: str) -> str:
    with pytest.raises(ModelError) as error:
        fmi2("", files=files).check_platform("model_exchange")
    message = str(error.value)
    assert message.startswith("x.fmu: must have ")
    return message


def test_a_binary_for_this_machine_is_enough():
    fmi2("", files=(HERE,)).check_platform("co_simulation")


def test_both_versions_name_this_machine_in_their_own_words():
    assert platform_for("2.0") == PLATFORM
    assert platform_for("3.0") == PLATFORM_TUPLE
    assert "-" in PLATFORM_TUPLE
    assert HERE.startswith(f"binaries/{PLATFORM}/m.")
    assert binary_path("3.0", "m").startswith(f"binaries/{PLATFORM_TUPLE}/m.")


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ((), f"but has one for no platform at all; export it for {PLATFORM}"),
        (("binaries/other/m.so",), f"but has one for other; export it for {PLATFORM}"),
        (
            ("binaries/linux32/m.so", "binaries/win32/m.dll"),
            "but has one for linux32, win32 (linux32 and win32: 32 bits, which a 64-bit program "
            "cannot load); export it for",
        ),
        (("sources/m.c",), "but holds sources alone; compile them, for example with the command"),
        (("sources/m.c", "binaries/other/m.so"), ", or compile its sources"),
        ((f"binaries/{PLATFORM}/n.so",), f"must have the binary {HERE} but has not; export it"),
    ],
)
def test_what_is_there_instead_is_named(files, sentence):
    assert sentence in refusal(*files)
