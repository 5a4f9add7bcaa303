"""A Python function of the user's, by name, by the text of its module, or as it is in memory."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from workers.errors import DataError
from workers.messages.checks import check_flag, check_name, check_text, shown


@dataclass(frozen=True)
class UserFunction:
    """A Python function of the user's, which runs on the workers.

    Attributes
    ----------
    module, name
        Where it stands.
    source
        The module's text, where it is a file of the user's; empty if the module is installed.
    equality
        For a constraint: whether what it returns must be 0, else at most 0.
    label
        What tables call it; `name` if empty.
    pickled
        The function itself, as `from_callable` makes it; empty if it is imported.

    Raises
    ------
    DataError
        If it has no module or no name, or something is no text.
    """

    module: str
    name: str
    source: str = field(default="", repr=False)
    equality: bool = False
    label: str = ""
    pickled: bytes = field(default=b"", repr=False)

    def __post_init__(self) -> None:
        check_name(self.module, "function.module", DataError)
        check_name(self.name, "function.name", DataError)
        for key in ("source", "label"):
            check_text(getattr(self, key), f"function {self.name!r}.{key}", DataError)
        check_flag(self.equality, f"function {self.name!r}.equality", DataError)

    @classmethod
    def from_callable(cls, function: Callable[..., Any], where: str) -> UserFunction:
        """Return a function as workers are sent it, in other processes and on other machines too.

        One of a script, a notebook or a closure goes as a whole, with what it holds: a copy, as it
        is now. One of a module goes by name, and each worker must be able to import that.

        Parameters
        ----------
        function
            A function, a lambda, or an object that can be called.
        where
            Opens the message.

        Raises
        ------
        DataError
            If it holds something that cannot leave this process.
        """
        from ray import cloudpickle  # which takes half a second to import

        try:
            pickled: bytes = cloudpickle.dumps(function)
        except (TypeError, ValueError, AttributeError, pickle.PicklingError) as error:
            reason = " ".join(str(error).split())
            raise DataError(
                f"{where}: must be a function that can be sent to workers, but {shown(function)} "
                f"contains an object that cannot be sent ({reason}); create that object inside the "
                "function"
            ) from None
        name = str(getattr(function, "__name__", type(function).__name__))
        module = str(getattr(function, "__module__", None) or "__main__")
        return cls(module, name, pickled=pickled)


def as_user_function(given: Any, where: str) -> Any:
    """Return a function as workers are sent it; anything else as it is, for others to refuse."""
    is_plain = callable(given) and not isinstance(given, type)
    return UserFunction.from_callable(given, where) if is_plain else given
