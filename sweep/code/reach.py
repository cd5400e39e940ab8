"""What the code of a function is: all that it can reach and that is the user's.

Reached are the names that a function refers to, as they are now: globals, closures, defaults, attributes of modules,
decorators and what they wrap, methods along the whole MRO of classes and of instances, elements of containers, imports
inside.  The user's is every module whose file belongs neither to Python nor to an installed distribution: an editable
install and what PYTHONPATH finds are the user's.  Functions and classes count by their syntax trees, values by a
canonical form, distributions by their versions.  docs/experiments.md says what is left out.
"""

import ast
import copy
import copyreg
import functools
import hashlib
import importlib
import importlib.util
import linecache
import os
import random
import sys
import sysconfig
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError

# Begins the names of the packages that the modules beside a user's file are in.
PREFIX = "linksweep_local_"

# The name in such a module under which its syntax tree is kept, as it was executed.
TREE = "__linksweep_tree__"

# Characters of a value that a store records as it is; of a longer one it records a digest.
LONGEST = 40

# Characters of a form that is kept as it is.
LONG_FORM = 200

# Objects of a value that are followed: about a second.
MOST_OBJECTS = 500_000

PLAIN = (bool, int, float, complex, str, bytes)
RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
# Methods that make an object: what they set is how it begins, not a change.
MAKING = ("__init__", "__new__", "__post_init__", "__init_subclass__", "__set_name__")

# Methods that change their object.
CHANGING = {
    *("append", "add", "extend", "update", "insert", "setdefault", "pop", "popitem", "clear"),
    *("discard", "remove", "sort", "reverse", "write", "put", "acquire"),
}

DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
DESCRIPTORS = (staticmethod, classmethod, property, functools.cached_property, functools.partialmethod)

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Names = Mapping[str, Any]

_STDLIB = Path(sysconfig.get_path("stdlib")).resolve()
_OURS = Path(__file__).parents[2]  # as it is imported: linksweep/sweep is a link in a checkout
_BEGAN = time.time()


def without_package(text: str) -> str:
    """Return a text without the packages of local modules, whose names differ from version to version."""
    while PREFIX in text:
        before, _, after = text.partition(PREFIX)
        text = before + after.partition(".")[2]
    return text


def label_of(value: Any) -> str:
    """Return the module and name of a function or class, the same in all processes."""
    return without_package(f"{value.__module__}.{value.__qualname__}")


def digest_of(content: str | bytes) -> str:
    """Return a short digest of a text or of the content of a file."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:12]


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
    if file in (None, "frozen", "built-in"):
        return () if top in sys.stdlib_module_names else None
    if Path(file).is_relative_to(_OURS):
        return ()
    # What pip has unpacked has a folder *.dist-info beside it, wherever that is; an editable install has it elsewhere
    path = Path(file).resolve()
    folder = next((around.parent for around in (path, *path.parents) if around.stem == top), path.parent)
    if any(folder.glob("*.dist-info")):
        names = [top] if version_of(top) != "not installed" else sorted({*packages_distributions().get(top, ())})
        return tuple(names) or None
    return () if path.is_relative_to(_STDLIB) else None


def distributions_of(module: str | None) -> tuple[str, ...] | None:
    """Return the distributions that a module belongs to, as `distributions_at`; it need not be loaded."""
    if not module or module == "__main__" or module.startswith(PREFIX):
        return None
    top, loaded = module.partition(".")[0], sys.modules.get(module)
    if loaded is None:
        spec = sys.modules[top].__spec__ if top in sys.modules else importlib.util.find_spec(top)
        file, folders = getattr(spec, "origin", None), getattr(spec, "submodule_search_locations", None)
    else:
        file, folders = getattr(loaded, "__file__", None), getattr(loaded, "__path__", None)
        if not file and not folders and not any(isinstance(one, FunctionType) for one in vars(loaded).values()):
            return ()  # made by an extension
    return distributions_at(file or next(iter(folders or ()), None), top)


def reach_of(roots: Mapping[str, Any]) -> "Reach":
    """Return all that some objects reach."""
    return Reach(roots, Reach(roots).changes())


class Reach:
    """All that some objects reach.

    ``parts`` has the digest or a short form of each function, class, value and distribution, by its kind and name;
    ``places`` the file and line of what is in a file; ``unnoticed`` the types of values that have no canonical form, by
    name; ``modules`` the user's modules among them, and ``taken`` the attributes that are taken of each; ``acting`` the
    names of those that act on others while they are imported.

    What code changes while it runs, such as a cache, is not the same from call to call: it counts by the statements
    with which it begins.  So the roots are walked twice: first only what runs when they are called, which says what
    changes, then all.
    """

    def __init__(self, roots: Mapping[str, Any], changed: frozenset[str] | None = None) -> None:
        """Follow all but what is ``changed``; without that only what runs, to learn it from `changes`."""
        self._changed, self._running = changed or frozenset(), changed is None
        self.parts: dict[str, str] = {}
        self.places: dict[str, str] = {}
        self.unnoticed: dict[str, str] = {}
        self.modules: dict[str, ModuleType] = {}
        self.taken: dict[str, set[str]] = {}
        self.acting: list[str] = []
        # Whose form is made, and whether any of it is left out.
        self._value, self._is_changing = "", False
        # The objects are kept beside their ids, so that no other object gets the same id meanwhile.
        self._followed: dict[int, Any] = {}
        self._values: dict[tuple[str, int], Any] = {}
        self._wrappers: dict[int, tuple[Any, str]] = {}
        self._called: set[int] = set()
        self._attributes: set[str] = set()
        self._todo: list[Any] = []
        self._changes: list[tuple[FunctionType, set[str]]] = []
        for name, value in roots.items():
            self._keep(f"value {name}", self._refer(name, value))
        for value in self._todo:  # which grows meanwhile
            if isinstance(value, type):
                self._class(value)
            elif isinstance(value, FunctionType):
                self._function(value)
            else:  # a module that is taken as a whole
                for name in [name for name in vars(value) if not name.startswith("__")]:
                    self._refer(*self._attribute(value, name))

    def changes(self) -> frozenset[str]:
        """Return what functions change that are called after what they belong to was made, as far as names tell."""
        changed: set[str] = set()
        for function, keys in self._changes:
            name = function.__name__
            by_name = (name in self._attributes or name.startswith("__")) and name not in MAKING
            changed |= keys if by_name or id(function) in self._called else set()
        return frozenset(changed)

    def _follow(self, value: Any) -> None:
        if id(value) not in self._followed:
            self._followed[id(value)] = value
            self._todo.append(value)

    def _keep(self, label: str, text: str) -> None:
        text, label = without_package(text), without_package(label)
        short = text if len(text) <= LONGEST and text.isprintable() else digest_of(text)
        # Closures of one function, or functions that a decorator has made, have one label.
        name, number = label, 1
        while text and self.parts.setdefault(name, short) != short:
            number += 1
            name = f"{label} ({number})"

    def _refer(self, label: str, value: Any, names: Names = MappingProxyType({})) -> str:
        """Follow a name, of a module that has these names; return what it stands for where that is code, else '' and
        note it as a value.
        """
        if (code := self._code(value)) is not None:
            return code
        if (label, id(value)) in self._values:
            return ""
        self._values[label, id(value)] = value
        name = label.removeprefix("default ").partition(" of ")[0].rpartition(".")[2]
        tree = tree_of(names.get("__file__") or "", names)
        if tree is not None and name in _lines(tree):
            self.places[f"value {without_package(label)}"] = f"{names['__file__']}, line {_lines(tree)[name]}"
        outer, self._value, self._is_changing = (self._value, self._is_changing), label, False
        text = self._form(value, {})
        if not self._changed.isdisjoint([name, f".{name}", label]):
            self._is_changing, text = True, "changes"
        # What is left out counts by the statements with which it begins.  A notebook has no such tree.
        if self._is_changing and tree is not None:
            begins = [one for one in tree.body if not isinstance(one, (*DEFINITIONS, ast.Import, ast.ImportFrom))]
            begins = [one for one in begins if any(getattr(node, "id", "") == name for node in ast.walk(one))]
            text += "".join(map(ast.unparse, begins)) + self._names(begins, names)
        self._value, self._is_changing = outer
        self._keep(f"value {label}", text)
        return ""

    def _attribute(self, module: ModuleType, name: str) -> tuple[str, Any, Names]:
        """Note that an attribute of a module is taken; return what refers to it."""
        self.taken.setdefault(module.__name__, set()).add(name)
        value = None
        with suppress(Exception):  # raised again by the function where it is called
            value = getattr(module, name)
        return f"{module.__name__}.{name}", value, vars(module)

    def _form(self, value: Any, known: dict[int, tuple[Any, str]]) -> str:
        """Return the canonical form of a value, the same in all processes, and follow the code in it.

        ``known`` has the objects of the value that have been met, and the form of each, or its number.
        """
        kind = type(value)
        if value is None or kind in PLAIN:
            return repr(value)
        if (code := self._code(value)) is not None:
            return code
        if id(value) in known:
            return known[id(value)][1]
        # Objects may refer to each other in a circle: inside it, one stands for itself by its number.
        known[id(value)] = value, f"object {len(known)}"
        # Each number that is drawn changes a generator; the seed is in the statement that begins it.
        if isinstance(value, RANDOM):
            self._is_changing = True
            return label_of(kind)
        if kind is np.ndarray and value.dtype.kind not in "OV":
            return f"array {value.dtype.str} {value.shape} {'' if self._running else digest_of(value.tobytes())}"
        try:
            if len(known) > MOST_OBJECTS or value is sys.modules or value is os.environ:
                raise OverflowError
            if kind in (dict, MappingProxyType):
                forms = [f"{self._form(key, known)}: {self._form(one, known)}" for key, one in value.items()]
            else:
                pieces = value if kind in (list, tuple, set, frozenset) else self._pieces(value)
                forms = [self._form(one, known) for one in pieces]
            inside = ", ".join(sorted(forms) if kind in (set, frozenset) else forms)
            # Digested where it is long: objects that share parts would else repeat their text at each level.
            text = f"{label_of(kind)} [{inside if len(inside) < LONG_FORM else digest_of(inside)}]"
        except Exception:  # whatever keeps an object from being taken apart; also where it is too deep
            text = label_of(kind)
            if self._value:
                self.unnoticed[without_package(self._value)] = text
        known[id(value)] = value, text
        return text

    def _pieces(self, value: Any) -> Sequence[Any]:
        """Return what makes an object, without what code changes; raises any exception where that is not known."""
        kind = type(value)
        # Of the attributes of a vectorised function the others are caches.
        if isinstance(value, np.vectorize):
            return value.pyfunc, value.otypes, value.signature
        if kind is MethodType:
            return value.__func__, value.__self__
        if kind is np.ufunc:
            raise TypeError("made by frompyfunc, which does not tell of what")
        registered = copyreg.dispatch_table.get(kind)
        reduced = registered(value) if registered is not None else value.__reduce_ex__(4)
        if isinstance(reduced, str):
            return (reduced,)
        function, args, state, items, pairs = (*reduced, None, None, None)[:5]
        states = state if isinstance(state, tuple) else (state,)  # __dict__ and slots
        kept = [self._kept(value, one) if isinstance(one, dict) else one for one in states]
        return function, args, *kept, list(items or ()), list(pairs or ())

    def _kept(self, value: Any, state: dict[Any, Any]) -> list[Any] | None:
        """Return the attributes of an object that neither code changes nor are cached properties, in order; None if
        there is none, as before anything was cached.
        """
        owners = ["", *map(label_of, type(value).__mro__)]
        changed = {key for key in state if not self._changed.isdisjoint(f"{owner}.{key}" for owner in owners)}
        self._is_changing |= bool(changed)
        cached = {key for key in state if isinstance(getattr(type(value), str(key), None), functools.cached_property)}
        return [(key, state[key]) for key in sorted(state.keys() - changed - cached - {"__doc__"}, key=str)] or None

    def _code(self, value: Any) -> str | None:  # noqa: PLR0911 (one for each kind)
        """Follow a function, class, module or wrapper, and return what stands for it; None for anything else."""
        if isinstance(value, ModuleType):
            if self._is_users(value.__name__):
                self._follow(value)
            return f"module {value.__name__}"
        if isinstance(value, type):
            if isinstance(value.__module__, str) and self._is_users(value.__module__):  # in C it may be a descriptor
                self._follow(value)
            return f"class {label_of(value)}"
        if isinstance(value, FunctionType):
            self._called.add(id(value))
            if self._is_users(value.__globals__.get("__name__")):
                self._follow(value)
                return f"function {label_of(value)}"
            # A wrapper that a library made may hold a function of the user's; other things that it holds, such as the
            # cache of a single dispatch, change when it is called.
            if id(value) not in self._wrappers:
                self._wrappers[id(value)] = value, ""
                outer, self._value = self._value, ""
                inside = [*_closure(value).values(), *vars(value).values()]
                forms = [form for one in inside if (form := self._form(one, {})) and type(one) in PLAIN]
                self._value, self._wrappers[id(value)] = outer, (value, f"{forms}")
            return f"function {label_of(value)} {self._wrappers[id(value)][1]}"
        around = getattr(value, "__self__", None) if isinstance(value, BuiltinFunctionType) else value
        if isinstance(value, BuiltinFunctionType) and (around is None or isinstance(around, ModuleType)):
            self._is_users(getattr(around, "__name__", None))
            return f"function {value.__name__}"
        if isinstance(value, np.ufunc) and "vectorized" not in value.__name__:
            self._is_users("numpy")
            return f"function {value.__name__}"
        with suppress(Exception):  # whatever a user's __getattr__ raises
            # Of a library, such as a cache; a method has the attributes of its function, but also an object.
            is_library = distributions_of(type(value).__module__) is not None
            if callable(value) and is_library and not isinstance(value, MethodType):
                return f"wrapped {self._form(value.__wrapped__, {})}"
        return None

    def _is_users(self, module: str | None) -> bool:
        """Return whether a module is the user's; count what it does while it is imported, or its distributions."""
        if (distributions := distributions_of(module)) is not None:
            self.parts |= {f"package {name}": version_of(name) for name in distributions}
            return False
        loaded = sys.modules.get(module or "")
        if loaded is not None and module is not None and module not in self.modules:
            self.modules[module], names = loaded, vars(loaded)
            file = names.get("__file__") or ""
            tree = tree_of(file, names)
            if file.endswith(tuple(EXTENSION_SUFFIXES)):
                self.parts[f"file {Path(file).name}"] = digest_of(Path(file).read_bytes())
            elif not self._running and (acts := _effects(tree, calls=module != "__main__")):
                self.acting.append(module)
                self._keep(f"module {module}", "".join(map(ast.unparse, acts)) + self._names(acts, names))
        return True

    def _function(self, function: FunctionType) -> None:
        """Add a function, and what it changes while it runs."""
        names, label, code = function.__globals__, label_of(function), function.__code__
        nodes = definitions_of(function)
        positional = code.co_varnames[: code.co_argcount]
        defaults = dict(zip(reversed(positional), reversed(function.__defaults__ or ()), strict=False))
        defaults |= function.__kwdefaults__ or {}
        text = "".join(self._refer(f"default {name} of {label}", value) for name, value in defaults.items())
        for name, value in vars(function).items():
            if not name.startswith("__") and f".{name}" not in self._changed:
                text += self._refer(f"{label}.{name}", value)
        # Without source there are only the values that it holds; what dataclasses make is in their class already.
        if not nodes:
            text += "".join(self._refer(f"{name} of {label}", value) for name, value in _closure(function).items())
            if not function.__name__.startswith("__") and "__file__" not in names:
                self.unnoticed[label] = "function without source"
        for node in nodes:
            self.places[f"function {label}"] = f"{code.co_filename}, line {code.co_firstlineno}"
            text += _text_of(node) + self._names([node], names, function)
            if not self._running:
                text += self._names(getattr(node, "decorator_list", ()), names)
            self._changes.append((function, set(_changes(node, function))))
        self._keep(f"function {label}", text)

    def _class(self, cls: type) -> None:
        """Add the statements of a class, and all that it has now."""
        label, names = label_of(cls), getattr(sys.modules.get(cls.__module__), "__dict__", {})
        text = f"{[self._code(base) for base in cls.__mro__[1:]]} {self._code(type(cls))}"
        files = [one.__code__.co_filename for one in vars(cls).values() if isinstance(one, FunctionType)]
        for file in dict.fromkeys((*files, names.get("__file__") or "")):
            for node in ast.walk(tree_of(file, names) or ast.Module([], [])):
                if isinstance(node, ast.ClassDef) and node.name == cls.__name__:
                    self.places[f"class {label}"] = f"{file}, line {node.lineno}"
                    body = [one for one in node.body if not isinstance(one, DEFINITIONS)]
                    own = [*node.decorator_list, *body[ast.get_docstring(node) is not None :]]
                    text += f"{[ast.unparse(one) for one in own]}{'' if self._running else self._names(own, names)}"
        # Methods count as functions, so that a message can name them; all else as it is now, also if it was set later.
        for name, value in vars(cls).items():
            attributes = ("__func__", "fget", "fset", "fdel", "func") if isinstance(value, DESCRIPTORS) else ()
            for inner in [getattr(value, one, None) for one in attributes] or [value]:
                if isinstance(inner, FunctionType) and self._is_users(inner.__globals__.get("__name__")):
                    self._follow(inner)
                elif not name.startswith(("__", "_abc_")) and inner is not None:
                    text += self._refer(f"{label}.{name}", inner)
        self._keep(f"class {label}", text)

    def _names(self, nodes: Iterable[ast.AST], names: Names, function: FunctionType | None = None) -> str:
        """Follow the names of globals in some code of a module with these names, or of globals and closures in that of
        a function; return what those stand for that are code.
        """
        nodes, module, bound = list(nodes), names.get("__name__", ""), list[str]()
        imported = {name: value for node in nodes for name, value in self._imported(node, names).items()}
        wanted, cells = (None, {}) if function is None else (_names_in(function.__code__), _closure(function))
        for name, path in sorted({use for node in nodes for use in _uses(node)}):
            if name in imported:
                reference: Any = f"{module}.{name}", imported[name], names
            elif wanted is not None and name not in wanted:
                continue
            elif function is not None and name in cells:
                reference = f"{name} of {label_of(function)}", cells[name]
            elif name in names:
                reference = f"{module}.{name}", names[name], names
            else:
                continue
            is_users = True
            for attribute in path:
                if not isinstance(reference[1], ModuleType):
                    break
                is_users = self._is_users(reference[1].__name__)
                reference = self._attribute(reference[1], attribute)
            # What a library has besides code, such as os.environ, is its own.
            stands = self._refer(*reference) if is_users else self._code(reference[1])
            bound.append(f"{name}{path} {stands or ''}")
        self._attributes.update(one.attr for node in nodes for one in ast.walk(node) if isinstance(one, ast.Attribute))
        return str(bound)

    def _imported(self, node: ast.AST, names: Names) -> dict[str, Any]:
        """Return what the import statements in some code bind; what is not the user's is not imported for this."""
        bound: dict[str, Any] = {}
        for one in ast.walk(node):
            for alias in one.names if isinstance(one, ast.Import | ast.ImportFrom) else ():
                alone: Any = ast.Import([alias])
                base = alias.name
                if isinstance(one, ast.ImportFrom):
                    alone, base = ast.ImportFrom(one.module, [alias], one.level), f"{'.' * one.level}{one.module or ''}"
                with suppress(Exception):  # raised again by the function where it is called
                    whole = importlib.util.resolve_name(base, names.get("__package__"))
                    if self._is_users(whole.partition(".")[0]):
                        statement = ast.fix_missing_locations(ast.Module([alone], []))
                        place = {name: names.get(name) for name in ("__name__", "__package__")}
                        exec(compile(statement, "imports", "exec"), place, bound)
        return bound


def _closure(function: FunctionType) -> dict[str, Any]:
    """Return the names in a function's closure with their values."""
    values: dict[str, Any] = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not filled yet
            values[name] = cell.cell_contents
    return values


def tree_of(filename: str, names: Names) -> ast.Module | None:
    """Return the syntax tree of the file, cell or argument that some code is from; None where there is no source."""
    if TREE in names and filename == names["__file__"]:
        return names[TREE]  # type: ignore[no-any-return]
    return _parsed(_source(filename, names))


def _source(filename: str, names: Names) -> str:
    if not filename.endswith(".py") and not filename.startswith("<") and "ipykernel" not in filename:
        return ""
    linecache.checkcache(filename)
    text = "".join(linecache.getlines(filename, dict(names)))
    if not text and filename == "<string>" and "-c" in sys.orig_argv and names.get("__name__") == "__main__":
        text = sys.orig_argv[sys.orig_argv.index("-c") + 1]
    return text


@lru_cache(maxsize=256)
def _parsed(text: str) -> ast.Module | None:
    try:
        return ast.parse(text) if text else None
    except SyntaxError:  # a cell with commands of IPython
        return None


def definitions_of(function: FunctionType) -> Sequence[Function]:
    """Return the definition of a function; that of all lambdas in its line, none where there is no source.

    Raises SweepError where its file has changed since it was imported: what it computes is no longer what is there.
    """
    code, names = function.__code__, function.__globals__
    if (tree := tree_of(code.co_filename, names)) is None:
        return ()
    # Only files that are younger than this process are compared: code objects of others may differ from those that
    # are compiled here, as pytest and coverage change what they import.  A cell of a notebook has no file.
    with suppress(OSError):
        is_younger = TREE not in names and os.stat(code.co_filename).st_mtime > _BEGAN
        if is_younger and code not in _codes(_source(code.co_filename, names), code.co_filename):
            why = "has changed since it was imported: import it again, or start a new session"
            raise SweepError(why, code.co_filename)
    return _functions(tree).get((code.co_firstlineno, code.co_name), ())


@lru_cache(maxsize=64)
def _codes(text: str, filename: str) -> frozenset[CodeType]:
    return frozenset(_inside(compile(text, filename, "exec", dont_inherit=True)))


def _inside(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _inside(constant)


@lru_cache(maxsize=256)
def _functions(tree: ast.Module) -> dict[tuple[int, str], list[Function]]:
    """Return functions by the line that they begin in, decorators included, and their name."""
    functions: dict[tuple[int, str], list[Function]] = {}
    for node in ast.walk(tree):
        if isinstance(node, Function):
            first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            functions.setdefault((first, getattr(node, "name", "<lambda>")), []).append(node)
    return functions


@lru_cache(maxsize=256)
def _lines(tree: ast.Module) -> dict[str, int]:
    """Return the line in which each name of a module is bound first."""
    nodes = [node for one in reversed(tree.body) if not isinstance(one, DEFINITIONS) for node in ast.walk(one)]
    imported = {node.asname or node.name: node.lineno for node in nodes if isinstance(node, ast.alias)}
    return imported | {
        node.id: node.lineno for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }


@lru_cache(maxsize=4096)
def _text_of(node: Function) -> str:
    """Return the text of a function without docstrings."""
    made = copy.deepcopy(node)
    for inner in ast.walk(made):
        if isinstance(inner, DEFINITIONS) and ast.get_docstring(inner) is not None:
            inner.body = inner.body[1:] or [ast.Pass()]
    return ast.unparse(made)


@lru_cache(maxsize=4096)
def _names_in(code: CodeType) -> frozenset[str]:
    """Return the names in the code of a function that are not bound there, and those of attributes."""
    return frozenset(name for one in _inside(code) for name in (*one.co_names, *one.co_freevars))


def _uses(node: ast.AST) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the names in some code, each with the attributes that are taken of it."""
    name, path = _chain(node)
    if name:
        yield name, path
    else:
        for inner in ast.iter_child_nodes(node):
            yield from _uses(inner)


def _chain(node: ast.AST) -> tuple[str, tuple[str, ...]]:
    """Return the name and the attributes of an expression like ``a.b.c``, '' for any other."""
    path: list[str] = []
    while isinstance(node, ast.Attribute):
        path.insert(0, node.attr)
        node = node.value
    return (node.id, tuple(path)) if isinstance(node, ast.Name) else ("", ())


def _effects(tree: ast.Module | None, calls: bool) -> list[ast.stmt]:
    """Return the statements of a module that act on others: set attributes or items, or, with ``calls``, call."""

    def acts(node: ast.AST) -> bool:
        if isinstance(node, (*DEFINITIONS, ast.Lambda)) or (
            isinstance(node, ast.If) and "__name__" in ast.unparse(node.test)
        ):
            return False
        if isinstance(node, ast.Attribute | ast.Subscript) and not isinstance(node.ctx, ast.Load):
            return True
        if calls and isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant):
            return True
        return any(map(acts, ast.iter_child_nodes(node)))

    return [one for one in tree.body if acts(one)] if tree is not None else []


def _changes(node: Function, function: FunctionType) -> Iterator[str]:
    """Yield the names that a function changes while it runs: as they are, with the label of its class before them for
    attributes of its own object, ``.name`` for those of others.
    """
    code, owner = function.__code__, label_of(function).rpartition(".")[0]
    is_method = "." in function.__qualname__ and not owner.endswith("<locals>")
    itself = code.co_varnames[:1] if is_method else ()
    names = _names_in(code) | set(code.co_varnames[: code.co_argcount + code.co_kwonlyargcount])
    for one in ast.walk(node):
        changed: Any = None
        if isinstance(one, ast.Global | ast.Nonlocal):
            yield from one.names
        elif isinstance(one, ast.Attribute | ast.Subscript) and not isinstance(one.ctx, ast.Load):
            changed = one
        elif isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr in CHANGING:
            changed = one.func.value
        while isinstance(changed, ast.Subscript):
            changed = changed.value
        if isinstance(changed, ast.Attribute):
            yield f"{owner if getattr(changed.value, 'id', '') in itself else ''}.{changed.attr}"
        elif isinstance(changed, ast.Name) and changed.id in names:
            yield changed.id
