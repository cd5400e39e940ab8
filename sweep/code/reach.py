"""What the code of a function is: all that it can reach and that is the user's.

Reached are the names that a function refers to, as they are now: globals, closures, defaults, attributes of modules,
decorators and what they wrap, methods along the whole MRO of classes and of instances, elements of containers, imports
inside.  The user's is every module whose file belongs neither to Python nor to an installed distribution: an editable
install and what PYTHONPATH finds are the user's.  Functions and classes count by their syntax trees, values by a
canonical form, distributions by their versions.  docs/experiments.md says what is left out.
"""

import ast
import copy
import enum
import functools
import hashlib
import importlib
import importlib.util
import linecache
import os
import random
import re
import symtable
import sys
import sysconfig
import time
from collections import deque
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any

import numpy as np

from linksweep.sweep.code.files import OURS, PREFIX, local_files_of
from linksweep.sweep.contract import SweepError

INSTALLED = {"site-packages", "dist-packages"}
"""Names of folders in which installed distributions are."""

CHANGING = frozenset(
    [
        "append",
        "add",
        "extend",
        "update",
        "insert",
        "setdefault",
        "pop",
        "popitem",
        "clear",
        "discard",
        "remove",
        "sort",
        "reverse",
        "write",
        "put",
        "acquire",
    ]
)
"""Methods that change their object."""

PLAIN = (bool, int, float, complex, str, bytes)
LONGEST = 40
"""Characters of a value that a store records as it is; of a longer one it records a digest."""

DEEPEST, MOST_OBJECTS = 100, 200_000
"""Objects within objects, and all objects of a value, that are followed."""

LONGEST_FORM = 1000

_BEGAN = time.time()
_STDLIB = Path(sysconfig.get_path("stdlib")).resolve()
_OURS = Path(__file__).parents[2]  # as it is imported: linksweep/sweep is a link in a checkout

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef
Key = tuple[Any, ...]


@cache  # a process computes with what it has imported, whatever is installed meanwhile
def version_of(distribution: str) -> str:
    """Return the version of a distribution when this was first called; "not installed" if there was none."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


@cache
def distributions_at(file: str | None, top: str) -> tuple[str, ...] | None:
    """Return the distributions that a module's file belongs to, none for Python and linksweep; None for the user's."""
    if file is None or file == "frozen":
        return () if top in sys.stdlib_module_names or top in sys.builtin_module_names else None
    if top == OURS and Path(file).is_relative_to(_OURS):
        return ()
    path = Path(file).resolve()
    if INSTALLED & set(path.parts) or _installed_beside(path, top):
        if version_of(top) != "not installed":
            return (top,)
        return tuple(sorted(set(packages_distributions().get(top, [])))) or None
    return () if path.is_relative_to(_STDLIB) else None


def _installed_beside(path: Path, top: str) -> bool:
    """Return whether a wheel was unpacked into the folder of a package, as by ``pip install --target``."""
    folder = next((around.parent for around in (path, *path.parents) if around.stem == top), path.parent)
    records = (record.read_text(errors="replace") for record in folder.glob("*.dist-info/RECORD"))
    return any(f"\n{path.relative_to(folder).as_posix()}," in f"\n{text}" for text in records)


def distributions_of(module: str | None) -> tuple[str, ...] | None:
    """Return the distributions that a loaded module belongs to, as `distributions_at`."""
    found = sys.modules.get(module or "")
    if module is None or module == "__main__" or module.startswith(PREFIX):
        return None
    if found is None:
        return None if module.partition(".")[0] not in sys.stdlib_module_names else ()
    file = getattr(found, "__file__", None) or next(iter(getattr(found, "__path__", ())), None)
    if file is None and not any(isinstance(value, FunctionType) for value in vars(found).values()):
        return ()  # made by an extension
    return distributions_at(file, module.partition(".")[0])


class Reach:
    """All that some objects reach.

    ``parts`` has the digest or a short form of each function, class, value and distribution, by its kind and name;
    ``places`` the file and line of what is in a file; ``unnoticed`` the types of values that have no canonical form, by
    name; ``modules`` the user's modules among them, and ``taken`` the attributes that are taken of each,
    ``acting`` the names of those that act on others while they are imported.
    """

    def __init__(self, roots: Mapping[str, Any]) -> None:
        self.parts: dict[str, str] = {}
        self.places: dict[str, str] = {}
        self.unnoticed: dict[str, str] = {}
        self.modules: list[ModuleType] = []
        self.taken: dict[str, set[str]] = {}
        self.acting: list[str] = []
        self._todo: deque[Any] = deque()
        self._seen: dict[int, Any] = {}  # kept, as are those below, so that no other object gets the same id
        self._owners: dict[int, type] = {}
        self._forms: dict[tuple[int, bool, bool], str] = {}
        self._kept: list[Any] = []
        self._calling, self._top, self._steps = False, 0, 0
        self._values: dict[str, list[tuple[Any, Mapping[str, Any]]]] = {}
        self._called: set[int] = set()
        self._attributes: set[str] = set()
        self._changes: list[tuple[FunctionType, type | None, set[Key]]] = []
        self._changed: set[Key] = set()
        self._forming: list[int] = []
        self._libraries: dict[int, str] = {}
        self._value = ""
        for name, value in roots.items():
            if code := self._refer(f"value {name}", value, {}, called=True):
                self._keep(f"value {name}", code)
        self._walk()
        self._give_forms()

    def form(self, value: Any, data: bool = True) -> str:
        """Return the canonical form of a value, the same in all processes, and follow the code in it.

        Without ``data`` the form is of the code in it alone.
        """
        if value is None or type(value) in PLAIN:
            return repr(value) if data else ""
        key = id(value), data, self._calling
        if key in self._forms:
            return self._forms[key]
        if id(value) in self._forming:
            level = self._forming.index(id(value))
            self._top = min(self._top, level)
            return f"<{len(self._forming) - level} up>"
        self._steps += 1
        if len(self._forming) > DEEPEST or self._steps > MOST_OBJECTS or value is sys.modules or value is os.environ:
            return self._without_form(value, data)
        above, self._top = self._top, len(self._forming)
        self._forming.append(id(value))
        try:
            form = self._form_of_code(value)
            if form is None:
                form = self._form_of_data(value, data and (id(value),) not in self._changed)
        finally:
            level = len(self._forming) - 1
            self._forming.pop()
        form = form if len(form) < LONGEST_FORM else hashlib.sha256(form.encode()).hexdigest()
        if self._top >= level:  # it depends on nothing around it
            self._kept.append(value)
            self._forms[key] = form
        self._top = min(above, self._top)
        return form

    def _walk(self) -> None:
        while self._todo:
            value, self._calling = self._todo.popleft(), False
            if isinstance(value, type):
                self._class(value)
            elif isinstance(value, FunctionType):
                self._function(value, self._owners.get(id(value)))
            else:
                for name, inner in list(vars(value).items()):
                    if not name.startswith("__"):
                        self.taken.setdefault(value.__name__, set()).add(name)
                        self._refer(f"value {without_package(value.__name__)}.{name}", inner, vars(value), called=True)

    def _give_forms(self) -> None:
        """Give each value its form.  What the code changes while it runs is not the same from call to call: how it
        begins counts, and the code in it.
        """
        done: set[tuple[str, int]] = set()
        while todo := [
            (label, value, names)
            for label, values in self._values.items()
            for value, names in values
            if (label, id(value)) not in done
        ]:
            self._changed = {
                key
                for function, owner, keys in self._changes
                if id(function) in self._called or (owner is not None and self._is_used(function.__name__))
                for key in keys
            }
            self._forms.clear()
            for label, value, names in todo:
                done.add((label, id(value)))
                changes = not self._changed.isdisjoint([(label,), (id(value),)]) or isinstance(value, RANDOM)
                self._value, self._steps, self._calling = label.removeprefix("value "), 0, False
                form = self.form(value, data=not changes)
                self._keep(label, f"{form}{self._beginning(self._value, names)}" if changes else form)
                if line := _bound(_tree(names.get("__file__") or "", names)).get(self._value.rpartition(".")[2]):
                    self.places[label] = f"{names['__file__']}, line {line}"
            self._walk()

    def _is_used(self, method: str) -> bool:
        return method not in MAKING and (method in self._attributes or method.startswith("__"))

    def _beginning(self, value: str, names: Mapping[str, Any]) -> str:
        """Return the statements of a module that are about one of its values, and follow the names in them."""
        tree, name = _tree(names.get("__file__") or "", names), value.rpartition(".")[2]
        texts = ""
        for statement in tree.body if tree is not None else ():
            is_value = not isinstance(statement, Definition | ast.Import | ast.ImportFrom)
            if is_value and any(isinstance(node, ast.Name) and node.id == name for node in ast.walk(statement)):
                texts += ast.unparse(statement) + self._names([statement], names, {}, called=False)
        return texts

    def _keep(self, label: str, text: str) -> None:
        text = without_package(text)
        short = text if len(text) <= LONGEST and text.isprintable() else hashlib.sha256(text.encode()).hexdigest()[:12]
        name, number = label, 1
        while self.parts.setdefault(name, short) != short:  # closures of one function
            number += 1
            name = f"{label} ({number})"

    def _refer(self, label: str, value: Any, names: Mapping[str, Any], called: bool) -> str:
        """Follow a name; return what it stands for where that is code, else '' and note it as a value."""
        self._calling, self._steps = called, 0
        form = self.form(value, data=False)
        if isinstance(value, FunctionType | type | ModuleType | BuiltinFunctionType) or _wrapped(value) is not None:
            return form
        known = self._values.setdefault(label, [])
        if not any(value is other for other, _ in known):
            known.append((value, names))
        return ""

    def _function(self, function: FunctionType, owner: type | None) -> None:
        code, names, label = function.__code__, function.__globals__, _label(function)
        cells = dict(_cells(function))
        defaults = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
        own = [(name, value) for name, value in vars(function).items() if not name.startswith("__")]
        held = [(f"default {number} of {label}", value) for number, value in enumerate(defaults)]
        held += [(f"{label}.{name}", value) for name, value in own]
        node = _definition(function)
        if node is None:
            held += [(f"{name} of {label}", value) for name, value in cells.items()]
            if not function.__name__.startswith("__") and "__file__" not in names:  # else a library has made it
                self.unnoticed[label] = "function without source"
        text = "".join(self._refer(f"value {name}", value, {}, called=False) for name, value in held)
        if node is not None:
            self.places[f"function {label}"] = f"{code.co_filename}, line {code.co_firstlineno}"
            body, decorators = _without_docstrings(node), list(getattr(node, "decorator_list", ()))
            text += f"{ast.unparse(body)} {[ast.unparse(decorator) for decorator in decorators]}"
            text += self._names(decorators, names, cells, called=False)
            later = _without_definition_time(body)
            called = id(function) in self._called or owner is not None
            text += self._names([later], names, cells, called, label)
            self._changes.append((function, owner, _changes(later, label, names, cells, owner)))
        self._keep(f"function {label}", text)

    def _class(self, cls: type) -> None:
        """Add the statements of a class, and all that it has now."""
        label, names = _label(cls), getattr(sys.modules.get(cls.__module__), "__dict__", {})
        text = f"{[self.form(base) for base in cls.__mro__[1:]]} {self.form(type(cls))}"
        files = [f.__code__.co_filename for f in vars(cls).values() if isinstance(f, FunctionType)]
        trees = (_tree(file, names) for file in (*files, names.get("__file__") or ""))
        node = next((node for tree in trees if tree and (node := _class_in(tree, cls.__qualname__))), None)
        if node is not None:
            self.places[f"class {label}"] = f"{(*files, names.get('__file__'))[0]}, line {node.lineno}"
            body = _without_docstrings(node)
            assert isinstance(body, ast.ClassDef), "as it was"
            body.body = [one for one in body.body if not isinstance(one, Definition)] or [ast.Pass()]
            body.decorator_list = node.decorator_list
            text += ast.unparse(body) + self._names([body], names, {}, called=False)
        for name, value in vars(cls).items():
            for inner in _inside(value):
                if isinstance(inner, FunctionType) and self._is_users(inner.__globals__.get("__name__")):
                    self._follow(inner, cls)
                elif not name.startswith(("__", "_abc_")) and not isinstance(value, type(cls)):
                    text += self._refer(f"value {label}.{name}", inner, {}, called=False)
        self._keep(f"class {label}", text)

    def _names(
        self, nodes: Sequence[ast.AST], names: Mapping[str, Any], cells: Mapping[str, Any], called: bool, of: str = ""
    ) -> str:
        """Follow the names of globals and closures in some code; return what those stand for that are code."""
        imported = dict(self._imports(nodes, names))
        wanted = {name for node in nodes for name in _global_names(ast.unparse(node))} | imported.keys()
        module = without_package(names.get("__name__", ""))
        bound = []
        for name, path in sorted(_uses(nodes, wanted)):
            scope: Mapping[str, Any] = next((s for s in (imported, cells, names) if name in s), {})
            if not scope:
                continue
            value, label, around = scope[name], f"{name} of {of}" if name in cells else f"{module}.{name}", names
            library = False
            for attribute in path:
                if not isinstance(value, ModuleType):
                    break
                library = self._note(value) is not None
                self.taken.setdefault(value.__name__, set()).add(attribute)
                label, around = f"{without_package(value.__name__)}.{attribute}", vars(value)
                try:
                    value = getattr(value, attribute)
                except Exception:  # raised again by the function where it is called
                    value = None
            around = {} if name in cells else around
            if library and not isinstance(value, FunctionType | type | ModuleType) and _wrapped(value) is None:
                continue  # what a library holds, such as os.environ, is its own
            bound.append(f"{name}{path} {self._refer(f'value {label}', value, around, called)}")
        self._attributes.update(one.attr for node in nodes for one in ast.walk(node) if isinstance(one, ast.Attribute))
        return str(bound)

    def _imports(self, nodes: Sequence[ast.AST], names: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        """Yield what the import statements in some code bind; what is not the user's is not imported for this."""
        for node in (inner for outer in nodes for inner in ast.walk(outer)):
            if isinstance(node, ast.Import):
                wanted = [(one.name, "", one.asname) for one in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = f"{'.' * node.level}{node.module or ''}"
                wanted = [(base, one.name, one.asname or one.name) for one in node.names]
            else:
                continue
            for name, attribute, bound in wanted:
                try:
                    whole = importlib.util.resolve_name(name, names.get("__package__"))
                    top = whole.partition(".")[0]
                    if not top.startswith(PREFIX) and self._count(_distributions_found(top)) is not None:
                        continue
                    value = importlib.import_module(whole)
                    if attribute:
                        loaded = hasattr(value, attribute)
                        value = getattr(value, attribute) if loaded else importlib.import_module(f"{whole}.{attribute}")
                except Exception:  # raised again by the function where it is called
                    continue
                yield (bound, value) if bound else (top, sys.modules[top])

    def _follow(self, value: Any, owner: type | None = None) -> None:
        known = id(value) in self._seen, id(value) in self._called, id(value) in self._owners
        self._seen[id(value)] = value
        if self._calling:
            self._called.add(id(value))
        if owner is not None:
            self._owners[id(value)] = owner
        if known != (True, id(value) in self._called, id(value) in self._owners):
            self._todo.append(value)

    def _note(self, module: ModuleType) -> tuple[str, ...] | None:
        """Count the distributions of a module; of one that is the user's, what it does while it is imported."""
        found = distributions_of(module.__name__)
        if found is None and not any(module is other for other in self.modules):
            self.modules.append(module)
            name, file = without_package(module.__name__), getattr(module, "__file__", None) or ""
            tree = None if file.endswith(tuple(EXTENSION_SUFFIXES)) else _tree(file, vars(module))
            if file.endswith(tuple(EXTENSION_SUFFIXES)):
                self.parts[f"file {Path(file).name}"] = hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]
            elif tree is not None and (effects := list(_effects(tree.body, name != "__main__"))):
                self.acting.append(module.__name__)
                text = "".join(map(ast.unparse, effects))
                self._keep(f"module {name}", text + self._names(effects, vars(module), {}, called=False))
        return self._count(found)

    def _count(self, found: tuple[str, ...] | None) -> tuple[str, ...] | None:
        self.parts |= {f"package {name}": version_of(name) for name in found or ()}
        return found

    def _is_users(self, module: Any) -> bool:
        if module is not None and not isinstance(module, str):
            return False  # some classes of C have a descriptor there
        loaded = sys.modules.get(module or "")
        return (distributions_of(module) if loaded is None else self._note(loaded)) is None

    def _form_of_code(self, value: Any) -> str | None:  # noqa: PLR0911 (one for each kind)
        """Follow a function, class or module, and return its name; None for anything else."""
        if isinstance(value, ModuleType):
            if self._note(value) is None:
                self._follow(value)
            return f"module {without_package(value.__name__)}"
        if isinstance(value, type):
            if self._is_users(value.__module__):
                self._follow(value)
            return f"class {_label(value)}"
        if isinstance(value, FunctionType):
            if self._is_users(value.__globals__.get("__name__")):
                self._follow(value)
                return f"function {_label(value)}"
            if id(value) not in self._libraries:  # a wrapper that a library made may hold a function of the user's
                self._libraries[id(value)] = f"function {_label(value)}"
                held = [self.form(one, type(one) in PLAIN) for _, one in (*_cells(value), *vars(value).items())]
                self._libraries[id(value)] += f" {[form for form in held if form]}"
            return self._libraries[id(value)]
        if isinstance(value, np.ufunc | BuiltinFunctionType):
            around = getattr(value, "__self__", None)
            if isinstance(value, np.ufunc) and "vectorized" in value.__name__:
                return None  # made by frompyfunc, which does not tell of what
            if around is not None and not isinstance(around, ModuleType):
                return f"{value.__name__} of {self.form(around)}"
            self._is_users("numpy" if around is None else around.__name__)
            return f"function {value.__name__}"
        if callable(value) and (wrapped := _wrapped(value)) is not None:
            return f"wrapped {self.form(wrapped)}"
        return None

    def _form_of_data(self, value: Any, data: bool) -> str:  # noqa: PLR0911 (one for each kind)
        kind = type(value)
        if kind is np.ndarray and value.dtype.kind not in "OV":
            return (
                f"array {value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}" if data else ""
            )
        if isinstance(value, functools.partial):
            return f"partial {self.form(value.func, data)} {self._several((value.args, value.keywords), data)}"
        if isinstance(value, MethodType):
            return f"{self.form(value.__func__, data)} of {self.form(value.__self__, data)}"
        if isinstance(value, np.vectorize):  # its other attributes are caches
            return f"vectorize {self._several((value.pyfunc, value.otypes, value.signature), data)}"
        if kind in CONTAINERS:
            return self._several(value, data)
        name = self.form(kind)
        if isinstance(value, enum.Enum):
            return f"{name}.{value.name}" if data else ""
        if isinstance(value, RANDOM):  # each number that is drawn changes it
            return name
        try:
            reduced = value.__reduce_ex__(4)
        except Exception:  # whatever keeps an object from being taken apart
            return self._without_form(value, data)
        if isinstance(reduced, str):
            return f"{name} {reduced}" if data else ""
        _, args, state, *more = (*reduced, None)[: max(3, len(reduced))]
        own: dict[Any, Any] = {}
        for part in state if isinstance(state, tuple) and kind.__module__ != "numpy" else (state,):
            own |= part if isinstance(part, dict) else {"": [own.get(""), part]}
        changed = {
            key for key in own if not self._changed.isdisjoint([(id(value), key), *((c, key) for c in kind.__mro__)])
        }
        parts = [f"{key}={self.form(own[key], data and key not in changed)}" for key in sorted(own, key=str)]
        parts += [self._several(list(several), data) for several in (args, *more) if several is not None]
        return f"{name} {parts}" if data else ""

    def _several(self, values: Any, data: bool) -> str:
        if isinstance(values, Mapping):
            forms = [f"{self.form(key, data)}: {self.form(value, data)}" for key, value in values.items()]
        else:
            forms = [self.form(value, data) for value in values]
        if not data:
            return ", ".join(sorted({form for form in forms if form.strip(": ")}))
        return f"{type(values).__name__}({', '.join(sorted(forms) if isinstance(values, set | frozenset) else forms)})"

    def _without_form(self, value: Any, data: bool) -> str:
        if data:
            self.unnoticed[self._value] = _label(type(value))
        return _label(type(value)) if data else ""


CONTAINERS = (list, tuple, set, frozenset, dict, MappingProxyType)
RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
MAKING = ("__init__", "__new__", "__post_init__", "__init_subclass__", "__set_name__")
"""Methods that make an object, and what they set is how it begins."""


def without_package(text: str) -> str:
    """Return a text without the packages of local modules."""
    return re.sub(rf"{PREFIX}[0-9a-f]+\.", "", text)


def _label(value: Any) -> str:
    return without_package(f"{value.__module__}.{value.__qualname__}")


def _wrapped(value: Any) -> Any:
    try:
        return getattr(value, "__wrapped__", None)
    except Exception:  # whatever a user's __getattr__ raises
        return None


def _cells(function: FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not filled yet
            yield name, cell.cell_contents


def _inside(value: Any) -> Iterable[Any]:
    """Return what an attribute of a class holds."""
    if isinstance(value, staticmethod | classmethod):
        return (value.__func__,)
    if isinstance(value, property):
        return [one for one in (value.fget, value.fset, value.fdel) if one is not None]
    return (value.func,) if isinstance(value, functools.cached_property | functools.partialmethod) else (value,)


def _distributions_found(top: str) -> tuple[str, ...] | None:
    """Return the distributions of a module that need not be loaded, as `distributions_at`."""
    if top in sys.modules:
        return distributions_of(top)
    spec = importlib.util.find_spec(top)
    places = () if spec is None else (spec.origin, *(spec.submodule_search_locations or ()))
    return () if spec is None else distributions_at(next((place for place in places if place), None), top)


def _tree(filename: str, names: Mapping[str, Any]) -> ast.Module | None:
    """Return the syntax tree of the file, cell or argument that some code is from; None where there is no source."""
    if (files := local_files_of(names.get("__name__") or "")) is not None and files.name_of(filename) is not None:
        return _parsed_local(files.package, str(files.name_of(filename)))
    return _parsed(text) if (text := _source(filename, names)) else None


def _source(filename: str, names: Mapping[str, Any]) -> str:
    if not filename.endswith(".py") and not filename.startswith("<") and "ipykernel" not in filename:
        return ""
    linecache.checkcache(filename)
    text = "".join(linecache.getlines(filename, dict(names)))
    if not text and filename == "<string>" and "-c" in sys.orig_argv and names.get("__name__") == "__main__":
        text = sys.orig_argv[sys.orig_argv.index("-c") + 1]
    return text


@lru_cache(maxsize=256)
def _parsed_local(package: str, file: str) -> ast.Module:
    files = local_files_of(package)
    assert files is not None, "the module is one of them"
    return files.tree(file)


@lru_cache(maxsize=256)
def _parsed(text: str) -> ast.Module | None:
    try:
        return ast.parse(text)
    except SyntaxError:  # a cell with commands of IPython
        return None


@lru_cache(maxsize=256)
def _definitions(tree: ast.Module) -> dict[int, list[Definition]]:
    """Return functions by the line that they begin in, decorators included."""
    found: dict[int, list[Definition]] = {}
    for node in ast.walk(tree):
        if isinstance(node, Definition):
            lines = [decorator.lineno for decorator in getattr(node, "decorator_list", ())]
            found.setdefault(min([node.lineno, *lines]), []).append(node)
    return found


@lru_cache(maxsize=256)
def _bound(tree: ast.Module | None) -> dict[str, int]:
    """Return the line in which each name of a module is bound first."""
    nodes = [] if tree is None else [node for statement in reversed(tree.body) for node in ast.walk(statement)]
    imported = {node.asname or node.name: node.lineno for node in nodes if isinstance(node, ast.alias)}
    stored = (node for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    return imported | {node.id: node.lineno for node in stored}


def _definition(function: FunctionType) -> Definition | None:
    """Return the definition of a function; raises SweepError where its file has changed since it was imported."""
    code, names = function.__code__, function.__globals__
    if (tree := _tree(code.co_filename, names)) is None:
        return None
    _require_unchanged(code, names)
    found = [
        n for n in _definitions(tree).get(code.co_firstlineno, ()) if getattr(n, "name", "<lambda>") == code.co_name
    ]
    if len(found) > 1:  # lambdas in one line
        known = [(p[0], p[2], p[1], p[3]) for p in code.co_positions() if None not in p and p[2] != p[3]]
        first, last = min(known, default=(0, 0, 0, 0))[:2], max(p[2:] for p in known) if known else (0, 0)
        around = [n for n in found if (n.lineno, n.col_offset) <= first and last <= (n.end_lineno, n.end_col_offset)]
        found = around[-1:] or found  # the innermost
    return found[0] if found else None


def _require_unchanged(code: CodeType, names: Mapping[str, Any]) -> None:
    try:
        is_older = os.stat(code.co_filename).st_mtime < _BEGAN
    except OSError:
        return
    is_local = local_files_of(names.get("__name__") or "") is not None
    if not is_older and not is_local and code not in _codes(_source(code.co_filename, names), code.co_filename):
        raise SweepError("has changed since it was imported: import it again, or start a new session", code.co_filename)


@lru_cache(maxsize=64)
def _codes(text: str, filename: str) -> frozenset[CodeType]:
    todo, found = [compile(text, filename, "exec", dont_inherit=True)], set()
    while todo:
        code = todo.pop()
        found.add(code)
        todo += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return frozenset(found)


def _class_in(tree: ast.AST, qualname: str) -> ast.ClassDef | None:
    found: ast.AST | None = tree
    for name in qualname.replace(".<locals>", "").split("."):
        inner = (
            [n for n in ast.walk(found) if isinstance(n, Definition) and getattr(n, "name", "") == name]
            if found
            else []
        )
        found = inner[0] if inner else None
    return found if isinstance(found, ast.ClassDef) else None


def _without_docstrings(node: Definition) -> Definition:
    """Return a copy of a definition without docstrings and decorators."""
    made = copy.deepcopy(node)
    if not isinstance(made, ast.Lambda):
        made.decorator_list = []
    for inner in ast.walk(made):
        if (
            isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            and ast.get_docstring(inner) is not None
        ):
            inner.body = inner.body[1:] or [ast.Pass()]
    return made


def _without_definition_time(node: Definition) -> Definition:
    """Return a copy of a definition without what is evaluated when it is defined: defaults and annotations."""
    made = copy.deepcopy(node)
    if isinstance(made, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        made.args.defaults, made.args.kw_defaults = [], [None for _ in made.args.kwonlyargs]
    if isinstance(made, ast.FunctionDef | ast.AsyncFunctionDef):
        made.returns = None
        for argument in (n for n in ast.walk(made.args) if isinstance(n, ast.arg)):
            argument.annotation = None
    return made


@lru_cache(maxsize=4096)
def _global_names(text: str) -> frozenset[str]:
    """Return the names in some code that its scope does not bind."""
    tables, found = [symtable.symtable(text, "code", "exec")], set()
    while tables:
        table = tables.pop()
        found |= {one.get_name() for one in table.get_symbols() if one.is_referenced() and one.is_global()}
        tables += table.get_children()
    return frozenset(found)


def _uses(nodes: Sequence[ast.AST], wanted: Container[str]) -> set[tuple[str, tuple[str, ...]]]:
    """Return the wanted names in some code, each with the attributes that are taken of it."""
    todo, found = list(nodes), set()
    while todo:
        node = todo.pop()
        name, path = _chain(node)
        if name in wanted:
            found.add((name, path))
        else:
            todo += ast.iter_child_nodes(node)
    return found


def _chain(node: ast.AST) -> tuple[str, tuple[str, ...]]:
    """Return the name and the attributes of an expression like ``a.b.c``, '' for any other."""
    path: list[str] = []
    while isinstance(node, ast.Attribute):
        path.insert(0, node.attr)
        node = node.value
    return (node.id, tuple(path)) if isinstance(node, ast.Name) else ("", ())


def _effects(body: Iterable[ast.stmt], calls: bool) -> Iterator[ast.stmt]:
    """Yield the statements of a module that act on others: set attributes or items, or, with ``calls``, call."""
    for one in body:
        targets = getattr(one, "targets", [getattr(one, "target", None)])
        is_call = isinstance(one, ast.Expr) and not isinstance(one.value, ast.Constant)
        inner = [*getattr(one, "body", ()), *getattr(one, "orelse", ()), *getattr(one, "finalbody", ())]
        inner += [s for handler in getattr(one, "handlers", ()) for s in handler.body]
        if isinstance(one, Definition) or (isinstance(one, ast.If) and "__name__" in ast.unparse(one.test)):
            continue
        if (
            (calls and is_call)
            or any(isinstance(target, ast.Attribute | ast.Subscript) for target in targets)
            or any(True for _ in _effects(inner, calls))
        ):
            yield one


def _changes(
    node: Definition, label: str, names: Mapping[str, Any], cells: Mapping[str, Any], owner: type | None
) -> set[Key]:
    """Return what a function changes: labels of names that it binds again, ids of objects, attributes of objects and of
    the class that it is a method of.
    """
    arguments = node.args.args if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else []
    own = arguments[0].arg if owner is not None and arguments else None
    keys: set[Key] = set()

    def changed(expression: ast.AST, attribute: str = "") -> None:
        while isinstance(expression, ast.Subscript):
            expression = expression.value
        name, path = _chain(expression)
        if name == own:
            if first := next(iter((*path, attribute)), ""):
                keys.update([(owner, first), (f"value {_label(owner)}.{first}",)])
            return
        value = cells.get(name, names.get(name))
        for part in path:
            value = getattr(value, part, None)
        if value is None or type(value) in PLAIN:
            return
        keys.add((id(value), attribute) if attribute else (id(value),))
        if attribute and isinstance(value, ModuleType):
            keys.add((f"value {without_package(value.__name__)}.{attribute}",))
        elif attribute and isinstance(value, FunctionType | type):
            keys.add((f"value {_label(value)}.{attribute}",))

    for one in ast.walk(node):
        if isinstance(one, ast.Global):
            keys.update((f"value {without_package(names.get('__name__', ''))}.{name}",) for name in one.names)
        elif isinstance(one, ast.Nonlocal):
            keys.update((f"value {name} of {label}",) for name in one.names)
        elif isinstance(one, ast.Subscript) and not isinstance(one.ctx, ast.Load):
            changed(one.value)
        elif isinstance(one, ast.Attribute) and not isinstance(one.ctx, ast.Load):
            changed(one.value, one.attr)
        elif isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr in CHANGING:
            changed(one.func.value)
    return keys
