"""What a function without a file consists of: its code, and all functions, values and local modules it refers to."""

import ast
import dis
import functools
import hashlib
import inspect
import pickle
import sys
import textwrap
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

from sweep.sources import INSTALLED, read_sources

CHANGING = {
    *("append", "add", "extend", "update", "insert", "setdefault", "pop", "popitem"),
    *("clear", "discard", "remove", "write", "put", "acquire", "__setitem__"),
}
"""Methods that change their object."""


class CodeParts:
    """Digests of the code of a function and of what it refers to, by kind and name; and its local modules."""

    def __init__(self) -> None:
        self.parts: dict[str, str] = {}
        self.modules: list[ModuleType] = []
        self._seen: set[int] = set()

    def add(self, kind: str, name: str, value: Any) -> None:
        """Add a value and what it refers to; ``kind`` is "function" or "value"."""
        if id(value) in self._seen:
            return
        self._seen.add(id(value))
        if isinstance(value, functools.partial):
            self._keep("value", f"arguments of {name}", _pickled((value.args, sorted(value.keywords.items()))))
            self.add("function", name, value.func)
        elif isinstance(value, MethodType):
            self._keep("value", f"object of {name}", _pickled(value.__self__))
            self.add("function", name, value.__func__)
        elif isinstance(value, FunctionType):
            self._function(name, value)
        elif isinstance(value, ModuleType):
            self._module(value)
        elif isinstance(value, type):
            if self._is_local(value.__module__):
                self._keep("function", name, _source(value) or _pickled(sorted(vars(value))))
        elif kind == "function" and callable(value) and not isinstance(value, type):
            self.add("function", type(value).__name__, type(value))
            self._keep("value", f"object of {name}", _pickled(getattr(value, "__dict__", None)))
        else:
            self._keep("value", name, _pickled(value))

    def _function(self, name: str, function: FunctionType) -> None:
        if not self._is_local(function.__module__):
            return
        if (module := sys.modules.get(function.__module__)) is not None:
            self._module(module)
        self._keep("function", name, _source(function) or "\n".join(_code(function.__code__)))
        changed = _changed(function.__code__)
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        for free, cell in cells:
            if free in changed:
                continue
            try:
                self.add("value", free, cell.cell_contents)
            except ValueError:  # not filled yet
                continue
        for used in _names(function.__code__):
            if used in function.__globals__ and used not in changed:
                self.add("value", used, function.__globals__[used])

    def _module(self, module: ModuleType) -> None:
        file = getattr(module, "__file__", None)
        known = module.__name__ == "__main__" or module in self.modules
        if known or not self._is_local(module.__name__) or file is None:
            return
        self.modules.append(module)
        self.parts |= read_sources(Path(file).resolve()).parts

    def _is_local(self, module: str | None) -> bool:
        """Return whether a module belongs neither to Python, nor to an installed distribution, nor to linksweep."""
        found = sys.modules.get(module or "")
        file = getattr(found, "__file__", None)
        top = (module or "").partition(".")[0]
        if module in (None, "__main__") or found is None:
            return True
        if file is None or top in sys.stdlib_module_names or top in ("sweep", "linksweep", "core"):
            return False
        return file.endswith(".py") and not INSTALLED & set(Path(file).parts)

    def _keep(self, kind: str, name: str, text: str) -> None:
        self.parts[f"{kind} {name}"] = hashlib.sha256(text.encode()).hexdigest()[:12]


def _source(value: Any) -> str | None:
    """Return the syntax tree of a function or class as text; None for a lambda or without source."""
    if getattr(value, "__name__", "") == "<lambda>":
        return None
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(value)))
    except (OSError, TypeError, SyntaxError, IndentationError):
        return None
    return ast.dump(tree)


def _code(code: CodeType) -> Iterator[str]:
    yield code.co_code.hex()
    yield repr((code.co_names, code.co_varnames, code.co_freevars))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        else:
            yield repr(constant)


def _names(code: CodeType) -> list[str]:
    """Return the names that a function's code may look up among globals, inner functions included."""
    own = [i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")]
    inner = [name for constant in code.co_consts if isinstance(constant, CodeType) for name in _names(constant)]
    return list(dict.fromkeys([*own, *inner]))


def _changed(code: CodeType) -> set[str]:
    """Return the names of objects that a function changes itself, such as a list that it appends to: such state differs
    from call to call while the code stays the same.
    """
    found: set[str] = set()
    loaded: deque[str] = deque(maxlen=3)
    for instruction in dis.get_instructions(code):
        name, argument = instruction.opname, instruction.argval
        if name in ("STORE_GLOBAL", "STORE_DEREF", "DELETE_GLOBAL"):
            found.add(argument)
        elif name in ("STORE_SUBSCR", "DELETE_SUBSCR"):
            found.update(loaded)
        elif loaded and (name == "STORE_ATTR" or (name in ("LOAD_METHOD", "LOAD_ATTR") and argument in CHANGING)):
            found.add(loaded[-1])
        loaded.append(argument if name in ("LOAD_GLOBAL", "LOAD_DEREF", "LOAD_NAME") else "")
    return found.union(*(_changed(constant) for constant in code.co_consts if isinstance(constant, CodeType))) - {""}


def _pickled(value: Any) -> str:
    try:
        return pickle.dumps(value, protocol=4).hex()
    except Exception:  # a lock, a file: only its type can be recorded
        return f"{type(value).__module__}.{type(value).__qualname__}"
