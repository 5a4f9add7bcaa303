"""Model descriptions written by hand, packed as FMUs without any code."""

from __future__ import annotations

import io
import zipfile

from workers.fmu.description import ModelDescription, describe

HEAD_2 = (
    '<fmiModelDescription fmiVersion="2.0" guid="{g}" modelName="m" numberOfEventIndicators="0">'
)
BOTH = '<ModelExchange modelIdentifier="m"/><CoSimulation modelIdentifier="m"/>'
HEAD_3 = '<fmiModelDescription fmiVersion="3.0" instantiationToken="{g}" modelName="m">'
END = "</fmiModelDescription>"


def packed(content: str | bytes, *files: str) -> bytes:
    """An archive with that description and empty files of those names."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as opened:
        opened.writestr("modelDescription.xml", content)
        for name in files:
            opened.writestr(name, b"")
    return archive.getvalue()


def fmi2(
    variables: str, rest: str = "", *, interfaces: str = BOTH, files: tuple[str, ...] = ()
) -> ModelDescription:
    """Describe an FMU of FMI 2; `rest` is the <ModelStructure> and what else follows."""
    text = f"{HEAD_2}{interfaces}<ModelVariables>{variables}</ModelVariables>{rest}{END}"
    return read(text, *files)


def fmi3(
    variables: str,
    rest: str = "",
    *,
    interfaces: str = BOTH,
    structural: dict[str, int] | None = None,
) -> ModelDescription:
    """Describe an FMU of FMI 3; `rest` is the <ModelStructure> and what else follows."""
    text = f"{HEAD_3}{interfaces}<ModelVariables>{variables}</ModelVariables>{rest}{END}"
    return describe("x.fmu", packed(text), structural)


def read(content: str | bytes, *files: str) -> ModelDescription:
    return describe("x.fmu", packed(content, *files))
