"""Model descriptions written by hand, packed as FMUs without any code."""

import io
import zipfile
import zlib
from pathlib import Path

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


def real(
    name: str,
    causality: str,
    reference: int = 0,
    *,
    variability: str = "",
    description: str = "",
    **attributes: object,
) -> str:
    """A real variable of FMI 2; `attributes` are those of its type, such as start and unit."""
    usual = "tunable" if causality == "parameter" else "continuous"
    reference = reference or zlib.crc32(name.encode())
    inner = " ".join(f'{key}="{value}"' for key, value in attributes.items())
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability or usual}" description="{description}"><Real {inner}/>'
        "</ScalarVariable>"
    )


def write_fmu(folder: Path, *variables: str) -> Path:
    """Write an FMU of FMI 2 that has these variables and no code."""
    path = folder / "described.fmu"
    text = f"{HEAD_2}{BOTH}<ModelVariables>{''.join(variables)}</ModelVariables>{END}"
    path.write_bytes(packed(text))
    return path
