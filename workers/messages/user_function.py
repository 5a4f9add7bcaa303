"""A user-defined Python function: by name, by the text of its module, or pickled."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from workers.errors import DataError
from workers.messages.checks import check_flag, check_name, check_text, shown


@dataclass(frozen=True)
class UserFunction:
    """A user-defined Python function, which runs on the workers.

    Attributes
    ----------
    module, name
        Module and name of the function.
    source
        Source text of the module, if it is a file of the user; empty if the module is installed.
    equality
        For a constraint: whether its value must be 0; otherwise at most 0.
    label
        Name in tables; `name` if empty.
    pickled
        The pickled function, from `from_callable`; empty if the function is imported.

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
        """Return a function in the form that is sent to workers, also on other machines.

        A function of a script, a notebook or a closure is pickled with its current contents. A
        function of a module is sent by name, and each worker must be able to import the module.

        Parameters
        ----------
        function
            A function, a lambda, or a callable object.
        where
            Start of the error message.

        Raises
        ------
        DataError
            If it contains something that cannot be sent to another process.
        """
        from ray import cloudpickle  # its import takes half a second

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
    """Return a callable in the form that is sent to workers; return anything else unchanged."""
    is_plain = callable(given) and not isinstance(given, type)
    return UserFunction.from_callable(given, where) if is_plain else given
