"""Functions that cannot be imported from a file: those of a notebook or of the running script, closures, lambdas.

They are identified by a digest of their code and of all that it refers to, and are sent to workers as a whole.
"""

import hashlib
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sweep.code_parts import CodeParts
from sweep.contract import Experiment, SweepError, shown
from sweep.functions.signature import name_of
from sweep.sources import INSTALLED

SESSION = "session"
"""Stands in place of a module in the reference of such a function: ``session:NAME-DIGEST``."""

_known: dict[str, "SessionFunction"] = {}


class SessionFunction:
    """A function or experiment of this session, or of another one that has sent it."""

    def __init__(self, function: Callable[..., Any] | Experiment) -> None:
        found = CodeParts()
        inner = vars(function) if isinstance(function, Experiment) else {name_of(function): function}
        for name, value in inner.items():
            found.add("function" if callable(value) else "value", name, value)
        self.function = function
        self.parts, self.modules = found.parts, found.modules
        text = repr(sorted(self.parts.items()))
        self.digest = hashlib.sha256(text.encode()).hexdigest()[:12]
        name = function.name if isinstance(function, Experiment) else name_of(function)
        self.reference = f"{SESSION}:{name}-{self.digest}"

    @property
    def path(self) -> str:
        """Its name among the sources that workers get."""
        return self.reference

    def __getstate__(self) -> dict[str, Any]:
        """Return the state with the function pickled; raises SweepError where that is not possible."""
        import cloudpickle

        registered = []
        try:
            for module in self.modules:  # workers may not have them
                cloudpickle.register_pickle_by_value(module)
                registered.append(module)
            payload = cloudpickle.dumps(self.function)
        except Exception as error:  # whatever keeps an object from being pickled
            raise SweepError(
                f"the function {self.reference.rpartition(':')[2].rpartition('-')[0]} cannot be sent to workers "
                f"({type(error).__name__}: {error}); use pool='threads' or pool='serial', or move it into a module"
            ) from error
        finally:
            for module in registered:
                cloudpickle.unregister_pickle_by_value(module)
        return {**vars(self), "function": payload, "modules": []}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, and the function from its bytes."""
        vars(self).update(state)
        self.function = pickle.loads(state["function"])


def keep(function: Callable[..., Any] | Experiment) -> str:
    """Make a function available by a reference in this process; return the reference."""
    found = SessionFunction(function)
    _known[found.reference] = found
    return found.reference


def provide(function: SessionFunction) -> None:
    """Make a function that another process has sent available in this one."""
    _known.setdefault(function.reference, function)


def session_function(reference: str) -> SessionFunction | None:
    """Return the function of a session that a reference names, None for a reference to a file or module.

    Raises SweepError where that session has ended.
    """
    place, _, name = reference.rpartition(":")
    if place != SESSION:
        return None
    if reference not in _known:
        raise SweepError(
            f"the function {shown(name.rpartition('-')[0])} was defined in a script or notebook, not in a module; "
            "compute with it from there"
        )
    return _known[reference]


def importable(function: Callable[..., Any] | Experiment) -> str | None:
    """Return the reference by which a function can be imported anywhere, None for one of this session."""
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    name = getattr(function, "__qualname__", "")
    if module is None or module.__name__ == "__main__" or getattr(module, name, None) is not function:
        return None
    file = getattr(module, "__file__", None)
    if file is None or INSTALLED & set(Path(file).parts) or "." in module.__name__:
        return f"{module.__name__}:{name}"
    return f"{Path(file).resolve()}:{name}" if file.endswith(".py") else None
