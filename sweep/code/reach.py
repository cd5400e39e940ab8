"""What the code of a function is: all that it can reach and that is the user's.

Reached are the names that a function refers to, as they are now: globals, closures, defaults, attributes of modules,
decorators and what they wrap, methods along the whole MRO of classes and of instances, elements of containers, imports
inside.  The user's is every module whose file belongs neither to Python nor to an installed distribution: an editable
install and what PYTHONPATH finds are the user's.  Functions and classes count by their syntax trees, values by a
canonical form, distributions by their versions.  docs/experiments.md says what is left out.
"""

import ast
import copyreg
import functools
import hashlib
import importlib
import importlib.util
import io
import os
import pickle
import random
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any

import numpy as np

from linksweep.sweep.code import syntax
from linksweep.sweep.code.files import PREFIX, without_package
from linksweep.sweep.code.syntax import PLAIN, Key, Names, cells_of, label_of

LONGEST = 40
"""Characters of a value that a store records as it is; of a longer one it records a digest."""

MOST_OBJECTS = 200_000
"""Objects of a value that are followed: about a second."""

RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
MAKING = ("__init__", "__new__", "__post_init__", "__init_subclass__", "__set_name__")
"""Methods that make an object: what they set is how it begins, not a change."""

DESCRIPTORS = (staticmethod, classmethod, property, functools.cached_property, functools.partialmethod)

_STDLIB = Path(sysconfig.get_path("stdlib")).resolve()
_OURS = Path(__file__).parents[2]  # as it is imported: linksweep/sweep is a link in a checkout


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
        return () if top in sys.stdlib_module_names else None
    if Path(file).is_relative_to(_OURS):
        return ()
    path = Path(file).resolve()
    # what pip has unpacked has a folder *.dist-info beside it, wherever that is; an editable install has it elsewhere
    folder = next((around.parent for around in (path, *path.parents) if around.stem == top), path.parent)
    if _is_site(folder) or {"site-packages", "dist-packages"} & set(path.parts):
        names = (
            (top,) if version_of(top) != "not installed" else tuple(sorted({*packages_distributions().get(top, ())}))
        )
        return names or None
    return () if path.is_relative_to(_STDLIB) else None


@cache
def _is_site(folder: Path) -> bool:
    return any(folder.glob("*.dist-info"))


def distributions_of(module: str | None) -> tuple[str, ...] | None:
    """Return the distributions that a module belongs to, as `distributions_at`; it need not be loaded."""
    if not module or module == "__main__" or module.startswith(PREFIX):
        return None
    top, loaded = module.partition(".")[0], sys.modules.get(module)
    if loaded is None:
        spec = importlib.util.find_spec(top) if top not in sys.modules else sys.modules[top].__spec__
        places = () if spec is None else (spec.origin, *(spec.submodule_search_locations or ()))
        return distributions_at(next((place for place in places if place), None), top)
    file = getattr(loaded, "__file__", None) or next(iter(getattr(loaded, "__path__", ())), None)
    if file is None and not any(isinstance(value, FunctionType) for value in vars(loaded).values()):
        return ()  # made by an extension
    return distributions_at(file, top)


class Reach:
    """All that some objects reach.

    ``parts`` has the digest or a short form of each function, class, value and distribution, by its kind and name;
    ``places`` the file and line of what is in a file; ``unnoticed`` the types of values that have no canonical form, by
    name; ``modules`` the user's modules among them, and ``taken`` the attributes that are taken of each; ``acting`` the
    names of those that act on others while they are imported.

    All code is followed first.  Then values get their forms, without what the code changes while it runs, such as a
    cache: that is not the same from call to call, and counts by the statements with which it begins.
    """

    def __init__(self, roots: Mapping[str, Any]) -> None:
        self.parts: dict[str, str] = {}
        self.places: dict[str, str] = {}
        self.unnoticed: dict[str, str] = {}
        self.modules: dict[int, ModuleType] = {}
        self.taken: dict[str, set[str]] = {}
        self.acting: list[str] = []
        self.changed: set[Key] = set()
        self.value = ""  # whose form is made; none while code is followed
        self._todo: list[tuple[Any, type | None, bool]] = []
        self._seen: dict[
            tuple[int, int, bool], tuple[Any, type | None, bool]
        ] = {}  # the objects, so that no other gets the same id
        self._libraries: dict[int, tuple[Any, str]] = {}
        self._values: dict[tuple[str, int], tuple[Any, Names]] = {}
        self._functions: list[tuple[FunctionType, type | None, set[Key]]] = []
        self._attributes: set[str] = set()
        self._called = False
        for name, value in roots.items():
            self._keep(f"value {name}", self._refer(f"value {name}", value, {}, called=True))
        done: set[tuple[str, int]] = set()
        self._walk()
        while todo := self._values.keys() - done:
            called = {id(value) for value, _, is_called in self._seen.values() if is_called}
            self.changed = {
                key
                for function, owner, keys in self._functions
                if id(function) in called or (owner is not None and self._is_used(function.__name__))
                for key in keys
            }
            done |= todo
            for label, number in sorted(todo, key=lambda key: key[0]):
                self._record(label, *self._values[label, number])
            self._walk()

    def form(self, value: Any) -> str:
        """Return the canonical form of a value, the same in all processes, and follow the code in it."""
        if value is None or type(value) in PLAIN:
            return repr(value)
        if (code := self.code(value)) is not None:
            return code
        file = io.BytesIO()
        try:
            _Form(self, file).dump(value)
        except (RecursionError, OverflowError):  # too deep, too large
            return self.formless(value)
        return hashlib.sha256(file.getvalue()).hexdigest()

    def formless(self, value: Any) -> str:
        """Note a value that has no canonical form, and return its type."""
        if self.value:
            self.unnoticed[self.value] = label_of(type(value))
        return label_of(type(value))

    def code(self, value: Any) -> str | None:  # noqa: PLR0911 (one for each kind)
        """Follow a function, class, module or wrapper, and return what stands for it; None for anything else."""
        if isinstance(value, ModuleType):
            if self._note(value):
                self._follow(value)
            return f"module {without_package(value.__name__)}"
        if isinstance(value, type):
            if self._is_users(value.__module__):
                self._follow(value)
            return f"class {label_of(value)}"
        if isinstance(value, FunctionType):
            if self._is_users(value.__globals__.get("__name__")):
                self._follow(value)
                return f"function {label_of(value)}"
            if id(value) not in self._libraries:  # a wrapper that a library made may hold a function of the user's
                self._libraries[id(value)] = value, f"function {label_of(value)}"
                outer, self.value = self.value, ""
                inside = [(one, self.form(one)) for _, one in (*cells_of(value), *vars(value).items())]
                self.value, plain = outer, [form for one, form in inside if type(one) in PLAIN]
                self._libraries[id(value)] = value, f"function {label_of(value)} {plain}"
            return self._libraries[id(value)][1]
        around = getattr(value, "__self__", None) if isinstance(value, BuiltinFunctionType) else None
        if isinstance(value, BuiltinFunctionType) and (around is None or isinstance(around, ModuleType)):
            self._is_users(around.__name__ if around is not None else None)
            return f"function {value.__name__}"
        if isinstance(value, np.ufunc) and "vectorized" not in value.__name__:
            self._is_users("numpy")
            return f"function {value.__name__}"
        wrapped = _wrapped(value)
        return None if wrapped is None else f"wrapped {self.form(wrapped)}"

    def _refer(self, label: str, value: Any, names: Names, called: bool) -> str:
        """Follow a name; return what it stands for where that is code, else '' and note it as a value."""
        self._called = called
        form = self.form(value)
        if isinstance(value, FunctionType | type | ModuleType | BuiltinFunctionType) or _wrapped(value) is not None:
            return form
        self._values.setdefault((label, id(value)), (value, names))
        return ""

    def _follow(self, value: Any, owner: type | None = None) -> None:
        key = id(value), id(owner), self._called
        if key not in self._seen:
            self._seen[key] = value, owner, self._called
            self._todo.append(self._seen[key])

    def _walk(self) -> None:
        for value, owner, called in self._todo:  # which grows meanwhile
            self._called = False  # methods run where their names are used
            if isinstance(value, type):
                self._class(value)
            elif isinstance(value, FunctionType):
                self._function(value, owner, called)
            else:
                for name, inner in list(vars(value).items()):
                    if not name.startswith("__"):
                        self.taken.setdefault(value.__name__, set()).add(name)
                        self._refer(f"value {without_package(value.__name__)}.{name}", inner, vars(value), called=True)
        self._todo.clear()

    def _record(self, label: str, value: Any, names: Names) -> None:
        self._called = False
        name, file = label.rpartition(".")[2], names.get("__file__") or ""
        if line := syntax.lines_of_names(syntax.tree_of(file, names)).get(name):
            self.places[label] = f"{file}, line {line}"
        if self.changed.isdisjoint([(label,), (id(value),)]) and not isinstance(value, RANDOM):
            self.value = label.removeprefix("value ")
            self._keep(label, self.form(value))
            self.value = ""
            return
        text = label_of(type(value))
        for statement in syntax.statements_of(file, names):
            is_value = not isinstance(statement, syntax.Function | ast.ClassDef | ast.Import | ast.ImportFrom)
            if is_value and any(isinstance(node, ast.Name) and node.id == name for node in ast.walk(statement)):
                text += ast.unparse(statement) + self._names([statement], names, {}, called=False)
        self._keep(label, text)

    def _is_used(self, method: str) -> bool:
        return method not in MAKING and (method in self._attributes or method.startswith("__"))

    def _keep(self, label: str, text: str) -> None:
        text = without_package(text)
        short = text if len(text) <= LONGEST and text.isprintable() else hashlib.sha256(text.encode()).hexdigest()[:12]
        name, number = label, 1
        while text and self.parts.setdefault(name, short) != short:  # closures of one function
            number += 1
            name = f"{label} ({number})"

    def _function(self, function: FunctionType, owner: type | None, called: bool) -> None:
        names, label, cells = function.__globals__, label_of(function), dict(cells_of(function))
        nodes = syntax.definitions_of(function)
        values = enumerate([*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()])
        inside = [(f"default {number} of {label}", value) for number, value in values]
        inside += [(f"{label}.{name}", value) for name, value in vars(function).items() if not name.startswith("__")]
        if not nodes:
            inside += [(f"{name} of {label}", value) for name, value in cells.items()]
            if not function.__name__.startswith("__") and "__file__" not in names:  # else a library has made it
                self.unnoticed[label] = "function without source"
        parts = [self._refer(f"value {name}", value, {}, called=False) for name, value in inside]
        for node in nodes:
            self.places[f"function {label}"] = (
                f"{function.__code__.co_filename}, line {function.__code__.co_firstlineno}"
            )
            text, decorators, body = syntax.parts_of(node)
            runs = called or owner is not None
            parts += [
                text,
                self._names(decorators, names, cells, False),
                self._names([body], names, cells, runs, label),
            ]
            self._functions.append((function, owner, syntax.changes(body, label, names, cells, owner)))
        self._keep(f"function {label}", "".join(parts))

    def _class(self, cls: type) -> None:
        """Add the statements of a class, and all that it has now."""
        label, names = label_of(cls), getattr(sys.modules.get(cls.__module__), "__dict__", {})
        text = f"{[self.form(base) for base in cls.__mro__[1:]]} {self.form(type(cls))}"
        files = [one.__code__.co_filename for one in vars(cls).values() if isinstance(one, FunctionType)]
        for file in dict.fromkeys((*files, names.get("__file__") or "")):
            for node in syntax.classes_of(cls, syntax.tree_of(file, names)):
                self.places[f"class {label}"] = f"{file}, line {node.lineno}"
                body = [one for one in node.body if not isinstance(one, syntax.Function | ast.ClassDef)]
                body = body[ast.get_docstring(node) is not None :]
                text += f"{list(map(ast.unparse, [*node.decorator_list, *body]))}"
                text += self._names([*node.decorator_list, *body], names, {}, called=False)
        for name, value in vars(cls).items():
            attributes = ("__func__", "fget", "fset", "fdel", "func") if isinstance(value, DESCRIPTORS) else ()
            for inner in [getattr(value, one, None) for one in attributes] or [value]:
                if isinstance(inner, FunctionType) and self._is_users(inner.__globals__.get("__name__")):
                    self._follow(inner, cls)
                elif not name.startswith(("__", "_abc_")) and inner is not None:
                    text += self._refer(f"value {label}.{name}", inner, {}, called=False)
        self._keep(f"class {label}", text)

    def _names(self, nodes: Iterable[ast.AST], names: Names, cells: Names, called: bool, label: str = "") -> str:
        """Follow the names of globals and closures in some code; return what those stand for that are code."""
        nodes, bound = list(nodes), []
        imported = dict(self._imports(nodes, names))
        for name, path in syntax.uses(nodes, imported):
            scope: Names = next((s for s in (imported, cells, names) if name in s), {})
            if not scope:
                continue
            value, around, library = scope[name], {} if scope is cells else names, False
            place = f"{name} of {label}" if scope is cells else f"{without_package(names.get('__name__', ''))}.{name}"
            for attribute in path:
                if not isinstance(value, ModuleType):
                    break
                library = not self._note(value)
                self.taken.setdefault(value.__name__, set()).add(attribute)
                place, around = f"{without_package(value.__name__)}.{attribute}", vars(value)
                try:
                    value = getattr(value, attribute)
                except Exception:  # raised again by the function where it is called
                    value = None
            if library and not isinstance(value, FunctionType | type | ModuleType) and _wrapped(value) is None:
                continue  # what a library has, such as os.environ, is its own
            bound.append(f"{name}{path} {self._refer(f'value {place}', value, around, called)}")
        self._attributes.update(one.attr for node in nodes for one in ast.walk(node) if isinstance(one, ast.Attribute))
        return str(bound)

    def _imports(self, nodes: Iterable[ast.AST], names: Names) -> Iterator[tuple[str, Any]]:
        """Yield what the import statements in some code bind; what is not the user's is not imported for this."""
        for node in (inner for outer in nodes for inner in ast.walk(outer)):
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            base = f"{'.' * node.level}{node.module or ''}" if isinstance(node, ast.ImportFrom) else ""
            for one in node.names:
                try:
                    whole = importlib.util.resolve_name(base or one.name, names.get("__package__"))
                    top = whole.partition(".")[0]
                    if self._count(top) is not None:
                        continue
                    value = importlib.import_module(whole)
                    if base and not hasattr(value, one.name):
                        importlib.import_module(f"{whole}.{one.name}")
                    value = getattr(value, one.name) if base else value if one.asname else sys.modules[top]
                except Exception:  # raised again by the function where it is called
                    continue
                yield one.asname or (one.name if base else top), value

    def _note(self, module: ModuleType) -> bool:
        """Return whether a module is the user's; count what it does while it is imported, or its distributions."""
        if self._count(module.__name__) is not None:
            return False
        if id(module) not in self.modules:
            self.modules[id(module)] = module
            name, file = without_package(module.__name__), getattr(module, "__file__", None) or ""
            if file.endswith(tuple(EXTENSION_SUFFIXES)):
                self.parts[f"file {Path(file).name}"] = hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]
            elif acts := syntax.effects(syntax.statements_of(file, vars(module)), calls=name != "__main__"):
                self.acting.append(module.__name__)
                text = "".join(map(ast.unparse, acts))
                self._keep(f"module {name}", text + self._names(acts, vars(module), {}, called=False))
        return True

    def _count(self, module: str | None) -> tuple[str, ...] | None:
        distributions = distributions_of(module)
        self.parts |= {f"package {name}": version_of(name) for name in distributions or ()}
        return distributions

    def _is_users(self, module: Any) -> bool:
        if module is not None and not isinstance(module, str):
            return False  # some classes of C have a descriptor there
        loaded = sys.modules.get(module or "")
        return self._count(module) is None if loaded is None else self._note(loaded)


class _Form(pickle.Pickler):
    """Pickles a value so that its bytes are the same in all processes: code by its name, sets in order, texts without
    whether they are one object, nothing that the code changes itself.
    """

    def __init__(self, reach: Reach, file: io.BytesIO) -> None:
        super().__init__(file, 4)
        self._reach, self._objects = reach, 0

    def persistent_id(self, value: Any) -> Any:  # noqa: PLR0911 (one for each kind)
        """Return what stands for a value; None for what is taken apart."""
        kind = type(value)
        if kind in (str, bytes):
            return f"{kind.__name__} {value!r}"
        if value is None or kind in PLAIN:
            return None
        self._objects += 1
        if self._objects > MOST_OBJECTS:
            raise OverflowError
        if (code := self._reach.code(value)) is not None:
            return code
        if isinstance(value, RANDOM) or (self._reach.value and (id(value),) in self._reach.changed):
            return label_of(kind)  # each number that is drawn changes it
        if value is sys.modules or value is os.environ:
            return self._reach.formless(value)
        if kind in (set, frozenset):
            return kind.__name__, sorted(map(self._reach.form, value))
        if kind is np.ndarray and value.dtype.kind not in "OV":
            content = hashlib.sha256(value.tobytes()).hexdigest() if self._reach.value else ""
            return f"array {value.dtype.str} {value.shape} {content}"
        return None

    def reducer_override(self, value: Any) -> Any:
        """Return how an object is made, of what the code does not change."""
        kind = type(value)
        if isinstance(value, np.vectorize):  # its other attributes are caches
            return kind, (value.pyfunc, value.otypes, value.signature)
        if kind is MethodType:
            return kind, (value.__func__, value.__self__)
        if kind is MappingProxyType:
            return dict, (dict(value),)
        try:
            if kind is np.ufunc:
                raise TypeError("made by frompyfunc, which does not tell of what")
            registered = copyreg.dispatch_table.get(kind)
            reduced = registered(value) if registered is not None else value.__reduce_ex__(4)
        except Exception:  # whatever keeps an object from being taken apart
            reduced = self._reach.formless(value)
        if isinstance(reduced, str):
            return str, (f"{label_of(kind)} {reduced}",)
        function, args, state, *more = (*reduced, None)[: max(3, len(reduced))]
        if isinstance(state, tuple) and all(isinstance(part, dict | None) for part in state):  # __dict__ and slots
            state = tuple(self._kept(value, part or {}) for part in state)
        elif isinstance(state, dict):
            state = self._kept(value, state) or None  # as before anything was cached
        return function, args, state, *more

    def _kept(self, value: Any, state: dict[Any, Any]) -> dict[Any, Any]:
        kinds, changed = type(value).__mro__, self._reach.changed if self._reach.value else set()
        return {
            key: state[key]
            for key in sorted(state, key=str)
            if changed.isdisjoint([(id(value), key), *((kind, key) for kind in kinds)])
            and not isinstance(getattr(type(value), str(key), None), functools.cached_property)
        }


def _wrapped(value: Any) -> Any:
    try:
        return getattr(value, "__wrapped__", None) if callable(value) else None
    except Exception:  # whatever a user's __getattr__ raises
        return None
