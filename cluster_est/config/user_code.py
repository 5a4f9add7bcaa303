"""Python functions that a config names: only where the user allows it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from cluster_est.errors import ConfigError
from workers.messages import UserFunction
from workers.residuals.functions import load

_NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class UserCode:
    """Finds functions.

    Attributes
    ----------
    base
        The config's folder, where their files may be.
    allowed
        Whether they may run.
    """

    base: Path
    allowed: bool

    def function(self, text: str, where: str, *, equality: bool = False) -> UserFunction:
        """Find the function "module:name".

        It is in MODULE.py beside the config, whose text is sent to the workers, or in a module that
        is installed on each of them.

        Raises
        ------
        ConfigError
            If it is not written so, or code is not allowed.
        ModelError
            If there is no such function.
        """
        if not _NAMED.fullmatch(text):
            raise ConfigError(f'{where}: must be "module:name" but is {text!r}')
        if not self.allowed:
            raise ConfigError(
                f"{where}: {text!r} is Python code, which runs only where it is allowed; if you "
                "trust this config and its code, add --allow-code"
            )
        module, name = text.split(":")
        file = self.base / f"{module}.py"
        source = ""
        if file.is_file():
            try:
                source = file.read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise ConfigError(f"{where}: {file} cannot be read ({error}); mend it") from error
        found = UserFunction(module, name, source, equality)
        load(found)
        return found
