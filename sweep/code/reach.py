"""What the code of a function is: all that it can reach and that is the user's.

Reached are the names that a function refers to, as they are now: globals, closures, defaults, attributes of modules,
decorators and what they wrap, methods along the whole MRO of classes and of instances, elements of containers, imports
inside.  The user's is every module whose file belongs neither to Python nor to an installed distribution: an editable
install and what PYTHONPATH finds are the user's.  Functions and classes count by their syntax trees, values by a
canonical form, distributions by their versions.  docs/experiments.md says what is left out.
"""

import ast
import functools
import hashlib
import io
import itertools
import linecache
import os
import random
import re
import sys
import sysconfig
import time
from collections import ChainMap, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec, resolve_name
from pathlib import Path
from types import CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
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

# Methods that change their object: those that its unchangeable twin lacks.
TWINS = ((list, tuple), (deque, tuple), (set, frozenset), (dict, MappingProxyType))
CHANGING = {name for one, fixed in TWINS for name in dir(one) if not hasattr(fixed, name)} - {"copy"}

# With which code may name anything of its module.
BY_NAME = ("globals", "eval", "exec", "sys.modules")

DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
IMPORTS = (ast.Import, ast.ImportFrom)
DESCRIPTORS = (staticmethod, classmethod, property, functools.cached_property)

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Names = Mapping[str, Any]

_STDLIB = Path(sysconfig.get_path("stdlib")).resolve()
_OURS = Path(__file__).parents[2]  # as it is imported: linksweep/sweep is a link in a checkout
_BEGAN = time.time()

unparsed = lru_cache(maxsize=4096)(ast.unparse)


def without_package(text: str) -> str:
    """Return a text without the packages of local modules, whose names differ from version to version."""
    return re.sub(rf"{PREFIX}\w*\.?", "", text) if PREFIX in text else text


def label_of(value: Any) -> str:
    """Return the module and name of a function or class, the same in all processes."""
    return without_package(f"{value.__module__}.{value.__qualname__}")


def digest_of(content: str | bytes) -> str:
    """Return a short digest of a text or of the content of a file."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()[:12]


@cache  # a process computes with what it has imported, whatever is installed meanwhile
def version_of(distribution: str) -> str:
    """Return the version of a distribution when this was first called; "not installed" if there was none."""
    with suppress(PackageNotFoundError):
        return version(distribution)
    return "not installed"


@cache
def distributions_at(file: str | None, top: str) -> tuple[str, ...] | None:
    """Return the distributions that a module's file belongs to, none for Python and linksweep; None for the user's."""
    if file in (None, "frozen", "built-in"):
        return () if top in sys.stdlib_module_names else None
    path = Path(file).resolve()
    # What pip has unpacked has a folder *.dist-info beside it, wherever that is; an editable install has it elsewhere
    folder = next((around.parent for around in (path, *path.parents) if around.stem == top), path.parent)
    if not Path(file).is_relative_to(_OURS) and any(folder.glob("*.dist-info")):
        names = [top] if version_of(top) != "not installed" else sorted({*packages_distributions().get(top, ())})
        return tuple(names) or None
    return () if Path(file).is_relative_to(_OURS) or path.is_relative_to(_STDLIB) else None


def distributions_of(module: str | None) -> tuple[str, ...] | None:
    """Return the distributions that a module belongs to, as `distributions_at`; it need not be loaded."""
    if not module or module == "__main__" or module.startswith(PREFIX):
        return None
    top = module.partition(".")[0]
    loaded = sys.modules.get(module) or sys.modules.get(top)
    spec = find_spec(top) if loaded is None else None
    file = getattr(loaded, "__file__", None) or getattr(spec, "origin", None)
    folders = getattr(loaded, "__path__", None) or getattr(spec, "submodule_search_locations", None) or ()
    if loaded and not file and not folders and not any(isinstance(one, FunctionType) for one in vars(loaded).values()):
        return ()  # made by an extension
    return distributions_at(file or next(iter(folders), None), top)


def reach_of(roots: Mapping[str, Any]) -> "Reach":
    """Return all that some objects reach."""
    return Reach(roots, Reach(roots).changes())


class Reach:
    """All that some objects reach.

    ``parts`` has the digest or a short form of each function, class, value and distribution, by its kind and name;
    ``places`` the file and line of what is in a file; ``unnoticed`` the types of values that have no canonical form, by
    name; ``modules`` the user's modules among them, and ``taken`` the attributes that are taken of each.

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
        self.taken: dict[str, set[str]] = defaultdict(set)
        # Whose form is made, and whether any of it is left out.
        self._value, self._is_changing = "", False
        # The objects are kept beside their ids, so that no other object gets the same id meanwhile.
        self._met: dict[Any, Any] = {}
        self._called: set[int] = set()
        self._attributes: set[str] = set()
        self._todo: list[tuple[Callable[[Any], None], Any]] = []
        self._changes: list[tuple[FunctionType, set[str]]] = []
        for name, value in roots.items():
            self._keep(f"value {name}", self._refer(name, value))
        for add, value in self._todo:  # which grows meanwhile
            add(value)

    def changes(self) -> frozenset[str]:
        """Return what functions change that are called after what they belong to was made, as far as names tell."""
        changed: set[str] = set()
        for function, keys in self._changes:
            name = function.__name__
            by_name = (name in self._attributes or name.startswith("__")) and name not in MAKING
            changed |= keys if by_name or id(function) in self._called else set()
        return frozenset(changed)

    def _follow(self, add: Callable[[Any], None], value: Any) -> None:
        if self._is_new(value, add.__name__):
            self._todo.append((add, value))

    def _is_new(self, value: Any, label: str) -> bool:
        """Return whether an object has not been met under this label."""
        number = len(self._met)
        self._met.setdefault((label, id(value)), value)
        return len(self._met) > number

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
        if self._is_new(value, label):
            name = label.removeprefix("default ").partition(" of ")[0].rpartition(".")[2]
            statements = _index(tree_of(names.get("__file__") or "", names))[name]
            if statements:
                self.places[f"value {without_package(label)}"] = f"{names['__file__']}, line {statements[0].lineno}"
            self._value, self._is_changing = label, not self._changed.isdisjoint([name, f".{name}", label])
            text = "changes" if self._is_changing else self._form(value, {})
            # What is left out counts by the statements with which it begins; of a notebook these are not known.
            if self._is_changing:
                begins = [one for one in statements if not isinstance(one, IMPORTS)]
                text += "".join(map(unparsed, begins)) + self._names(begins, names)
                if names and not begins:
                    self.unnoticed[without_package(label)] = label_of(type(value))
            self._keep(f"value {label}", text)
        return ""

    def _attribute(self, module: ModuleType, name: str) -> tuple[str, Any, Names]:
        """Note that an attribute of a module is taken; return what refers to it."""
        self.taken[module.__name__].add(name)
        value = None
        with suppress(Exception):  # raised again by the function where it is called
            value = getattr(module, name)
        return f"{module.__name__}.{name}", value, vars(module)

    def _code(self, value: Any) -> str | None:
        """Follow a function, class or module, and return what stands for it; None for anything else."""
        if isinstance(value, ModuleType):
            if self._is_users(value.__name__):
                self._follow(self._whole, value)
            return f"module {value.__name__}"
        if isinstance(value, type):
            if isinstance(value.__module__, str) and self._is_users(value.__module__):  # in C it may be a descriptor
                self._follow(self._class, value)
            return f"class {label_of(value)}"
        if isinstance(value, FunctionType):
            self._called.add(id(value))
            self._follow(self._function, value)
            return f"function {label_of(value)}"
        return None

    def _form(self, value: Any, known: dict[int, tuple[Any, str]]) -> str:
        """Return the canonical form of a value, the same in all processes, and follow the code in it.

        ``known`` has the objects of the value that have been met, and the form of each, or its number.
        """
        kind = type(value)
        if value is None or kind in PLAIN:
            return without_package(repr(value))
        if (code := self._code(value)) is not None:
            return code
        if id(value) in known:
            return known[id(value)][1]
        # Objects may refer to each other in a circle: inside it, one stands for itself by its number.
        known[id(value)] = value, f"object {len(known)}"
        try:
            if len(known) > MOST_OBJECTS or value is os.environ:
                raise OverflowError
            forms = [self._form(one, known) for one in self._pieces(value)]
            inside = ", ".join(sorted(forms) if kind in (set, frozenset) else forms)
            # Digested where it is long: objects that share parts would else repeat their text at each level.
            text = f"{label_of(kind)} [{inside if len(inside) < LONG_FORM else digest_of(inside)}]"
        except Exception:  # whatever keeps an object from being taken apart; also where it is too deep
            text, self._is_changing = label_of(kind), True
            if self._value:
                self.unnoticed[without_package(self._value)] = text
        known[id(value)] = value, text
        return text

    def _pieces(self, value: Any) -> Iterable[Any]:  # noqa: PLR0911 (one for each kind)
        """Return what makes an object, without what code changes; raises any exception where that is not known."""
        import cloudpickle  # which takes apart what pickle cannot

        kind = type(value)
        if kind in (list, tuple, set, frozenset, dict):
            return itertools.chain.from_iterable(value.items()) if kind is dict else iter(value)
        if kind is np.ndarray and value.dtype.kind not in "OV":
            return value.dtype.str, value.shape, digest_of(value.tobytes())
        if isinstance(
            value, RANDOM
        ):  # each number that is drawn changes it; the seed is in the statement that begins it
            self._is_changing = True
            return ()
        if isinstance(value, DESCRIPTORS):
            return [getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "func")]
        if isinstance(value, np.vectorize):  # whose other attributes are caches
            return value.pyfunc, value.otypes, value.signature
        # A wrapper of a library, such as a cache; a method has the attributes of its function, but also an object.
        is_library = distributions_of(kind.__module__) is not None
        if is_library and callable(value) and hasattr(value, "__wrapped__") and kind is not MethodType:
            return (value.__wrapped__,)
        if isinstance(value, io.IOBase) or (kind is np.ufunc and "vectorized" in value.__name__):
            raise TypeError("an open file, or made by frompyfunc, which does not tell of what")
        reduce = cloudpickle.Pickler.dispatch_table.get(kind)
        reduced = reduce(value) if reduce is not None else value.__reduce_ex__(4)
        if isinstance(reduced, str):  # to be found in its module
            self._is_users(getattr(value, "__module__", None) or kind.__module__)
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

    def _is_users(self, module: str | None) -> bool:
        """Return whether a module is the user's; count what it does while it is imported, or its distributions."""
        if (distributions := distributions_of(module)) is not None:
            self.parts |= {f"package {name}": version_of(name) for name in distributions}
        elif module in sys.modules:
            self._follow(self._acts, sys.modules[module])
        return distributions is None

    def _acts(self, module: ModuleType) -> None:
        """Add what the user's module does to others while it is imported."""
        name, file = module.__name__, getattr(module, "__file__", None) or ""
        self.modules[name] = module
        if file.endswith(tuple(EXTENSION_SUFFIXES)):
            self.parts[f"file {Path(file).name}"] = digest_of(Path(file).read_bytes())
        acts = [one for one in tree_of(file, vars(module)).body if _is_act(one, calls=name != "__main__")]
        if acts and not self._running:
            self._keep(f"module {name}", "".join(map(unparsed, acts)) + self._names(acts, vars(module)))

    def _whole(self, module: ModuleType) -> None:
        for name in [name for name in vars(module) if not name.startswith("__") or name == "__getattr__"]:
            self._refer(*self._attribute(module, name))

    def _function(self, function: FunctionType) -> None:
        """Add a function, and what it changes while it runs."""
        names, label, code = function.__globals__, label_of(function), function.__code__
        if not self._is_users(names.get("__name__")):
            # A wrapper that a library made may hold a function of the user's, or a number; other things that it holds,
            # such as the cache of a single dispatch, change when it is called.
            self._value, around = "", [*_closure(function).values(), *vars(function).values()]
            forms = [form for one in around if (form := self._form(one, {})) and type(one) in PLAIN]
            self._keep(f"function {label}", ", ".join(forms))
            return
        nodes, values = definitions_of(function), function.__defaults__ or ()
        defaults = dict(zip(code.co_varnames[code.co_argcount - len(values) :], values, strict=False))
        defaults |= function.__kwdefaults__ or {}
        inside = {f"default {name} of {label}": value for name, value in defaults.items()}
        members = {name for name in vars(function) if not name.startswith("__") and f".{name}" not in self._changed}
        inside |= {f"{label}.{name}": vars(function)[name] for name in members}
        # Without source there are only the values that it holds; what dataclasses make is in their class already.
        if not nodes:
            inside |= {f"{name} of {label}": value for name, value in _closure(function).items()}
            if not function.__name__.startswith("__") and "__file__" not in names:
                self.unnoticed[label] = "function without source"
        text = "".join(itertools.starmap(self._refer, sorted(inside.items())))
        for node in nodes:
            self.places[f"function {label}"] = f"{code.co_filename}, line {code.co_firstlineno}"
            text += unparsed(node) + self._names([node], names, function)
            if not self._running:
                text += self._names(getattr(node, "decorator_list", ()), names)
            self._changes.append((function, set(_changes(node, function))))
        self._keep(f"function {label}", text)

    def _class(self, cls: type) -> None:
        """Add the statements of a class, and all that it has now."""
        label, names = label_of(cls), getattr(sys.modules.get(cls.__module__), "__dict__", {})
        text = f"{[self._code(base) for base in cls.__mro__[1:]]} {self._code(type(cls))}"
        # Methods count as functions, so that a message can name them; all else as it is now, also if it was set later.
        files = [names.get("__file__") or ""]
        for name, value in vars(cls).items():
            inside = self._pieces(value) if isinstance(value, DESCRIPTORS) else [value]
            for inner in inside:
                if isinstance(inner, FunctionType):
                    self._follow(self._function, inner)
                    files.append(inner.__code__.co_filename)
                elif not name.startswith(("__", "_abc_")) and inner is not None:
                    text += self._refer(f"{label}.{name}", inner)
        for file in dict.fromkeys(files):
            for node in _index(tree_of(file, names))[f"class {cls.__name__}"]:
                self.places[f"class {label}"] = f"{file}, line {node.lineno}"
                members = [*node.decorator_list, *(one for one in node.body if not isinstance(one, DEFINITIONS))]
                text += f"{[unparsed(one) for one in members]}{'' if self._running else self._names(members, names)}"
        self._keep(f"class {label}", text)

    def _names(self, nodes: Iterable[ast.AST], names: Names, function: FunctionType | None = None) -> str:
        """Follow the names of globals in some code of a module with these names, or of globals and closures in that of
        a function; return what those stand for that are code.
        """
        nodes, stand = list(nodes), list[str]()
        imported, cells = self._imported(nodes, names), {} if function is None else _closure(function)
        wanted = names.keys() if function is None else {*imported, *_names_in(function.__code__)}
        scope = ChainMap(imported, cells, dict(names))
        for chain in sorted({chain for node in nodes for chain in _chains(node)}):
            name, *path = chain.split(".")
            by_name = chain in BY_NAME and (name not in scope or scope[name] is sys)
            if by_name and names.get("__name__") in sys.modules:
                self._follow(self._whole, sys.modules[names["__name__"]])
            if name not in scope or name not in wanted:
                continue
            value, home, is_users = scope[name], names, True
            label = f"{name} of {label_of(function)}" if name in cells else f"{names.get('__name__', '')}.{name}"
            for attribute in path:
                if not isinstance(value, ModuleType):
                    break
                is_users = self._is_users(value.__name__)
                label, value, home = self._attribute(value, attribute)
            # What a library has besides code, such as os.environ, is its own.
            stand.append(f"{chain} {(self._refer(label, value, home) if is_users else self._code(value)) or ''}")
        self._attributes.update(one.attr for node in nodes for one in ast.walk(node) if isinstance(one, ast.Attribute))
        return str(stand)

    def _imported(self, nodes: Iterable[ast.AST], names: Names) -> dict[str, Any]:
        """Return what the import statements in some code bind; what is not the user's is not imported for this."""
        bound: dict[str, Any] = {}
        for one in (inner for node in nodes for inner in ast.walk(node) if isinstance(inner, IMPORTS)):
            base = f"{'.' * one.level}{one.module or ''}" if isinstance(one, ast.ImportFrom) else ""
            with suppress(Exception):  # raised again by the function where it is called
                modules = [resolve_name(base or alias.name, names.get("__package__")) for alias in one.names]
                if True in [self._is_users(module.partition(".")[0]) for module in modules]:
                    exec(unparsed(one), {"__package__": names.get("__package__")}, bound)
        return bound


def _closure(function: FunctionType) -> dict[str, Any]:
    """Return the names in a function's closure with their values."""
    values: dict[str, Any] = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not filled yet
            values[name] = cell.cell_contents
    return values


def tree_of(filename: str, names: Names) -> ast.Module:
    """Return the syntax tree of the file, cell or argument that some code is from; empty where there is no source."""
    if TREE in names and filename == names["__file__"]:
        return names[TREE]  # type: ignore[no-any-return]
    return _parsed(_source(filename, names))


def _source(filename: str, names: Names) -> str:
    linecache.checkcache(filename)
    text = "".join(linecache.getlines(filename, dict(names)))
    if not text and filename == "<string>" and "-c" in sys.orig_argv and names.get("__name__") == "__main__":
        text = sys.orig_argv[sys.orig_argv.index("-c") + 1]
    return text


@lru_cache(maxsize=256)
def _parsed(text: str) -> ast.Module:
    try:
        return without_docstrings(ast.parse(text))
    except SyntaxError:  # a cell with commands of IPython
        return ast.Module([], [])


def without_docstrings(tree: ast.Module) -> ast.Module:
    """Return a tree, changed in place."""
    for node in ast.walk(tree):
        if isinstance(node, (*DEFINITIONS, ast.Module)) and ast.get_docstring(node, clean=False) is not None:
            node.body[:1] = [ast.Pass()] if len(node.body) == 1 else []
    return tree


def definitions_of(function: FunctionType) -> Sequence[Function]:
    """Return the definition of a function; that of all lambdas in its line, none where there is no source.

    Raises SweepError where its file has changed since it was imported: what it computes is no longer what is there.
    """
    code, names = function.__code__, function.__globals__
    # Only files that are younger than this process are compared: code objects of others may differ from those that
    # are compiled here, as pytest and coverage change what they import.  A cell of a notebook has no file.
    with suppress(OSError):
        is_younger = TREE not in names and os.stat(code.co_filename).st_mtime > _BEGAN
        if is_younger and code not in _codes(_source(code.co_filename, names), code.co_filename):
            why = "has changed since it was imported: import it again, or start a new session"
            raise SweepError(why, code.co_filename)
    return _index(tree_of(code.co_filename, names))[code.co_firstlineno, code.co_name]


@lru_cache(maxsize=64)
def _codes(text: str, filename: str) -> frozenset[CodeType]:
    return frozenset(_inside(compile(text, filename, "exec", dont_inherit=True)))


def _inside(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _inside(constant)


@lru_cache(maxsize=4096)
def _names_in(code: CodeType) -> frozenset[str]:
    """Return the names in the code of a function that are not bound there, and those of attributes."""
    return frozenset(name for one in _inside(code) for name in (*one.co_names, *one.co_freevars))


@lru_cache(maxsize=256)
def _index(tree: ast.Module) -> Mapping[Any, list[Any]]:
    """Return functions by the line that they begin in, decorators included, and their name; classes by theirs; and the
    other statements of a module by the names in them.
    """
    index: dict[Any, list[Any]] = defaultdict(list)
    for node in ast.walk(tree):
        if isinstance(node, Function):
            first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            index[first, getattr(node, "name", "<lambda>")].append(node)
        elif isinstance(node, ast.ClassDef):
            index[f"class {node.name}"].append(node)
    for one in (one for one in tree.body if not isinstance(one, DEFINITIONS)):
        aliases = {node.asname or node.name for node in ast.walk(one) if isinstance(node, ast.alias)}
        for name in aliases | {node.id for node in ast.walk(one) if isinstance(node, ast.Name)}:
            index[name].append(one)
    return index


@lru_cache(maxsize=4096)
def _chains(node: ast.AST) -> frozenset[str]:
    """Return the names in some code, each with the attributes that are taken of it: ``a``, ``a.b.c``."""
    parts = [one for one in ast.walk(node) if isinstance(one, ast.Name | ast.Attribute)]
    inner = {id(one.value) for one in parts if isinstance(one, ast.Attribute)}
    chains = {unparsed(one) for one in parts if id(one) not in inner}
    return frozenset(chain for chain in chains if re.fullmatch(r"[\w.]+", chain))


def _written(node: ast.AST) -> Iterator[ast.expr]:
    """Yield the attributes and items that some code sets, and what it calls a method of that changes its object."""
    for one in ast.walk(node):
        if isinstance(one, ast.Attribute | ast.Subscript) and not isinstance(one.ctx, ast.Load):
            yield one
        elif isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr in CHANGING:
            yield one.func.value


def _is_act(statement: ast.stmt, calls: bool) -> bool:
    """Return whether a statement of a module acts on others: changes them, or, with ``calls``, calls what may."""
    is_script = isinstance(statement, ast.If) and "__name__" in unparsed(statement.test)
    if is_script or isinstance(statement, DEFINITIONS):
        return False
    called = (
        one for one in ast.walk(statement) if isinstance(one, ast.Expr) and not isinstance(one.value, ast.Constant)
    )
    return any(_written(statement)) or (calls and any(called))


def _changes(node: Function, function: FunctionType) -> Iterator[str]:
    """Yield the names that a function changes while it runs: as they are, with the label of its class before them for
    attributes of its own object, ``.name`` for those of others.
    """
    code, owner = function.__code__, label_of(function).rpartition(".")[0]
    itself = code.co_varnames[:1] if "." in function.__qualname__ and not owner.endswith("<locals>") else ()
    names = _names_in(code) | set(code.co_varnames[: code.co_argcount + code.co_kwonlyargcount])
    for one in ast.walk(node):
        yield from one.names if isinstance(one, ast.Global | ast.Nonlocal) else ()
    for written in _written(node):
        changed = written
        while isinstance(changed, ast.Subscript):
            changed = changed.value
        if isinstance(changed, ast.Attribute):
            yield f"{owner if unparsed(changed.value) in itself else ''}.{changed.attr}"
        elif isinstance(changed, ast.Name) and changed.id in names:
            yield changed.id
