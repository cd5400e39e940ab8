"""Which code a function is, where it is found, and how other processes get it.

The code of a function is all that it can reach and that is the user's.  Reached are the names that it refers to, as
they are now: globals, closures, defaults, attributes of modules, decorators and what they wrap, methods along the whole
MRO of classes and of instances, elements of containers, imports inside.  The user's is every module whose file belongs
neither to Python nor to an installed distribution: an editable install and what PYTHONPATH finds are the user's.
Functions and classes count by their syntax trees, values by a canonical form, distributions by their versions.
docs/experiments.md says what is left out.

References to code are ``module:attribute``, ``path/to/file.py:attribute``, and ``session:NAME-DIGEST`` for a function
that only this session has.  A function that is given in Python is computed as this session has it, whatever its file
holds.
"""

import ast
import builtins
import ctypes
import hashlib
import importlib.abc
import importlib.util
import io
import json
import linecache
import logging
import os
import pickle
import random
import re
import subprocess
import symtable
import sys
import sysconfig
import time
import traceback
import typing
from collections import ChainMap, defaultdict, namedtuple
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache, cached_property, lru_cache, partial
from importlib.machinery import EXTENSION_SUFFIXES, FileFinder, ModuleSpec, PathFinder, SourceFileLoader
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from itertools import accumulate, chain
from operator import attrgetter
from pathlib import Path
from textwrap import indent
from types import CellType, CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any, ClassVar, NewType, SupportsAbs, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from linksweep.sweep.contract import Experiment, Named, SweepError, shown, suggest
from linksweep.sweep.functions.adapter import ATTRIBUTE, experiment_of, name_of

# Begins the names of the packages that the modules beside a user's file are in.
PREFIX = "linksweep_local_"

# The name in such a module under which its syntax tree is kept, as it was executed.
TREE = "__linksweep_tree__"

# Characters of a value that a store records as it is; of a longer one it records a digest.
LONGEST = 40

PLAIN = (bool, int, float, complex, str, bytes, type(None))
PATHS = (str, type(Path()))  # what may be a path

# Methods that change their object: those that its unchangeable twin lacks, and of arrays, which have none.
CHANGING = {*dir(list), *dir(set), *dir(dict), "fill", "put"} - {*dir(tuple), *dir(frozenset), *dir(MappingProxyType)}

# Methods that make an object: what they set of it is how it begins, not a change; so is all that those of classes do.
MAKING = ("__init__", "__new__", "__post_init__")
MAKING_CLASSES = ("__init_subclass__", "__set_name__")
# What stands for the class of an object in its methods.
ITSELF = r"(cls|type\(self\)|__class__)(\.|$)"

# What pickle may take apart, but is not the same from call to call.
UNSTEADY = (np.random.Generator, np.random.RandomState, random.Random, FileFinder)

# Packages whose objects lead to all that was ever entered in a notebook or computed on a cluster, or into files.
ELSEWHERE = ("IPython.", "ipykernel.", "distributed.", "xarray.backends.", "zarr.")

# With which code may name anything of its module.
BY_NAME = (globals, eval, exec, sys.modules)

# Names of modules by which they know where they are.
PLACES = ("__file__", "__path__")

# Attributes of classes that Python sets: some are caches, and what is not is in the statements of the class.
PYTHONS = ("__", "_abc_", "_value2member_map_", "_hashable_values_", "_unhashable_values_")
NOTHING = (type(None), type(vars(namedtuple("_", "field"))["field"]))  # the second is what gets a field

DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
IMPORTS = (ast.Import, ast.ImportFrom)
CHANGEABLE = (list, dict, set, bytearray, np.ndarray)
DESCRIPTORS = (staticmethod, classmethod, property, cached_property, np.vectorize)
# What a class has that nothing but its statements has made.
PLAIN_CLASS = {*dir(type), *dir(SupportsAbs), "__weakref__", "__firstlineno__", "__static_attributes__"}
# What such objects, and wrappers of libraries, have besides caches.
WRAPPED = ("__func__", "fget", "fset", "fdel", "func", "pyfunc", "otypes", "signature", "__wrapped__", "_self_wrapper")
# What a type stands for that is pickled by its name: an alias, a NewType, a type variable.
MEANT = ("__value__", "__supertype__", "__bound__", "__constraints__")

ALIAS: Any = getattr(typing, "TypeAliasType", NewType)  # Python 3.12 and later

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Names = dict[str, Any]

_STDLIB = Path(sysconfig.get_path("stdlib")).resolve()
_PACKAGE = Path(__file__).parents[1]  # as it is imported: linksweep/sweep is a link in a checkout
_BEGAN = time.time()

# Our package, never looked for beside a user's file.
OURS = "linksweep"

# What a script is called, in a process that was spawned by the second name.
MAIN = ("__main__", "__mp_main__")

# Begins the parts with what names a value in its module, which counts where the value differs from process to process.
STATEMENT = "statement "

# Stands in place of a module in the reference of a function that only this session has.
SESSION = "session"

# As the positions of instructions are written.
_place_of = attrgetter("lineno", "end_lineno", "col_offset", "end_col_offset")

SUFFIXES = ("/__init__.py", *EXTENSION_SUFFIXES, ".py")  # as Python prefers them
DIGEST = re.compile("(^| )[0-9a-f]{12}( |$)")
# Fields of an experiment that its code does not depend on, or that count by themselves.
DESCRIBING = ("name", "version", "parameters", "outputs", "sample_outputs", "packages", "citation", "outer_draw")

# Code by its path or reference and its digest, also what another process has sent: the file may be missing here, or be
# another. Without a digest: as this process has it now.
_codes: dict[tuple[str, str | None], "LocalFiles | Live"] = {}

_places: dict[str, str] = {}

unparsed = lru_cache(maxsize=4096)(ast.unparse)
_warn = cache(logging.getLogger("linksweep").warning)  # a process says it once


def without_package(text: str) -> str:
    """Return a text without the packages of local modules, whose names differ from version to version, and with the
    name by which others import the script or module that Python executes.
    """
    text = re.sub(r"(?<![\w.'\"/])__mp_main__\b", MAIN[0], text) if MAIN[1] in text else text
    if "__main__" in text and not (sys.flags.interactive or hasattr(sys, "ps1")):  # where %run would change the name
        main = sys.modules.get("__main__")
        ran = [(spec.origin, spec.name)] if (spec := getattr(main, "__spec__", None)) else []
        files = str(getattr(main, "__file__", "")), *sys.argv[:1]  # the second where cProfile executes it
        ran += [(file, Path(file).stem) for file in files if file.endswith(".py")]
        names = [name for file, name in ran if distributions_at(file, name.partition(".")[0]) is None]
        text = re.sub(r"(?<![\w.'\"/])__main__\b", (*names, MAIN[0])[0], text)
    return re.sub(rf"{PREFIX}\w*\.?", "", text) if PREFIX in text else text


def label_of(value: Any) -> str:
    """Return the module and name of a function or class, the same in all processes."""
    return without_package(f"{value.__module__}.{value.__qualname__}")


def digest_of(content: str | bytes) -> str:
    """Return a short digest of a text or of the content of a file."""
    if isinstance(content, str):
        content = content.encode(errors="surrogateescape")  # names of files need not be UTF-8
    return hashlib.sha256(content).hexdigest()[:12]


@cache  # a process computes with what it has imported, whatever is installed meanwhile
def version_of(distribution: str) -> str:
    """Return the version of a distribution when this was first called; "not installed" if there was none."""
    with suppress(PackageNotFoundError):
        return version(distribution)
    return "not installed"


@cache  # looking up distributions with another name, such as scikit-learn, takes half a second
def _distributions_with(top: str) -> tuple[str, ...]:
    is_name = version_of(top) != "not installed"
    return (top,) if is_name else tuple(sorted({*packages_distributions().get(top, ())}))


@cache
def distributions_at(file: str | None, top: str) -> tuple[str, ...] | None:
    """Return the distributions that a module's file belongs to, none for Python and linksweep; None for the user's."""
    if file in (None, "frozen", "built-in"):
        return () if top in sys.stdlib_module_names else None
    path, is_ours = Path(file).resolve(), Path(file).is_relative_to(_PACKAGE)
    # What pip has unpacked has a folder *.dist-info beside it, wherever that is; an editable install has it elsewhere
    folder = next((around.parent for around in (path, *path.parents) if around.stem == top), path.parent)
    if not is_ours and any(folder.glob("*.dist-info")):
        return _distributions_with(top) or None
    return () if is_ours or path.is_relative_to(_STDLIB) else None


def distributions_of(module: str | None) -> tuple[str, ...] | None:
    """Return the distributions that a module belongs to, as `distributions_at`; it need not be loaded."""
    if not module or module == "__main__" or module.startswith(PREFIX):
        return None
    top = module.partition(".")[0]
    there = sys.modules.get(module) or sys.modules.get(top)
    spec = getattr(there, "__spec__", None) if there else importlib.util.find_spec(top)
    file = (spec.origin or next(iter(spec.submodule_search_locations or ()), None)) if spec else None
    return distributions_at(file, top)


def reach_of(roots: Mapping[str, Any], module: str = "") -> "Reach":
    """Return all that some objects reach, and the module that names them.

    What code changes while it runs, such as a cache, is not the same from call to call: it counts by the statements
    with which it begins.  So the roots are walked twice: first only what runs when they are called, which says what
    changes, then all.
    """
    return Reach(roots, Reach(roots), module)


class Reach:
    """All that some objects reach.

    ``parts`` has the digest or a short form of each function, class, value and distribution, by its kind and name;
    ``places`` the file and line of what is in a file; ``unnoticed`` the types of values that have no canonical form, by
    name; ``modules`` the user's modules among them; ``acting`` those that act on others while they are imported, in the
    order in which they do.
    """

    def __init__(self, roots: Mapping[str, Any], first: "Reach | None" = None, module: str = "") -> None:
        """Follow all but what the ``first`` walk says is changed; without that only what runs, to learn it."""
        self._is_running, self._changed = first is None, frozenset(first.changed() if first else ())
        # Of modules that make paths of their place, with their names: in a copy of them these paths are others.
        self.folders: set[tuple[str, str]] = {*first.folders} if first else set()
        # Paths that stand in the source: these are the same in a copy.
        self.written: set[str] = {*first.written} if first else set()
        self._called: set[str] = {*first._called} if first else set()
        self._changes: list[tuple[str, set[str]]] = []
        self.places: dict[str, str] = {}
        self.unnoticed: dict[str, str] = {}
        self.statements: dict[str, str] = {}
        self.modules: dict[str, ModuleType] = {}
        self.classes: dict[str, set[int]] = defaultdict(set)  # their ids by their names
        self.acting: list[str] = []
        self._texts: dict[str, set[str]] = defaultdict(set)
        # Numbers of functions and classes that have one name, by their ids.
        self._alike: dict[str, dict[int, tuple[int, Any]]] = defaultdict(dict)
        # Whose form is made, and whether any of it is left out, or may be by how the user's classes are pickled.
        self._value, self._is_partial, self._is_hiding = "", False, False
        # The user's name through which what is followed is reached.
        self._through = ""
        # The objects are kept beside their ids, so that no other object gets the same id meanwhile.
        self._met: dict[Any, Any] = {}
        self._todo: list[tuple[Any, ...]] = []
        self._is_users(module)
        for name, value in roots.items():
            self._keep(f"value {name}", self._refer(name, value, {}))
        for through, add, *what in self._todo:  # which grows meanwhile
            self._through = through
            add(*what)
        self.unnoticed.pop("", None)  # of wrappers that libraries made
        self._keep("order of modules", ", ".join(self.acting) if len(self.acting) > 1 else "")
        texts = {label: ", ".join(sorted(some)) for label, some in self._texts.items()}
        self.parts = {k: v if len(v) <= LONGEST and v.isprintable() else digest_of(v) for k, v in texts.items()}

    def changed(self) -> set[str]:
        """Return what functions change that are called after what they belong to was made, as far as names tell."""
        classes = [one for known in self._alike.values() for _, one in known.values() if isinstance(one, type)]
        made = {f"{base.__name__}()" for one in classes if f"{one.__name__}()" in self._called for base in one.__mro__}
        return {key for name, keys in self._changes if name[:2] == "__" or name in self._called | made for key in keys}

    def _follow(self, add: Callable[..., None], value: Any, *more: Any) -> None:
        if (key := (add.__name__, id(value), *more[:1])) not in self._met:
            self._met[key] = value
            self._todo.append((self._through, add, value, *more))

    def _keep(self, label: str, text: str) -> None:
        if text:
            self._texts[without_package(label)].add(without_package(text))

    def _refer(self, label: str, value: Any, names: Names | None = None) -> str:
        """Follow a name, of a module that has these names; return what it stands for where that is code, else ''.

        Without names, what the value begins with is in the code of what has it.
        """
        self._through = label if names and " of " not in label else self._through
        if (code := self._code(value)) is None:
            self._follow(self._noted, value, label, names)
        return code or ""

    def _noted(self, value: Any, label: str, names: Names | None) -> None:
        """Add a value; what is left out of it counts by the statements that name it in its module."""
        name, around = label.partition(" of ")[0].rpartition(".")[2], names or {}
        index = _index(tree_of(around.get("__file__") or "", around))
        # nothing there binds what is in a closure, but what makes the function that has it
        statements = index[name if " of " not in label else self._through.rpartition(".")[2]]
        if statements:
            self.places[f"value {label}"] = f"{around['__file__']}, line {statements[0].lineno}"
            text = without_package("".join(map(unparsed, statements)))
            self.statements[without_package(f"{STATEMENT}{label}")] = digest_of(text)
        is_changed = not self._changed.isdisjoint((name, label))
        self._value, self._is_hiding, self._is_partial = label, False, is_changed or f"{name}." in self._changed
        text = "" if is_changed else self._form(value, {})
        begins = self._text(statements, around) if self._is_partial or self._is_hiding else ""
        if self._is_partial and names is not None and not begins:  # as in a notebook
            self.unnoticed[label] = label_of(type(value))
        self._keep(f"value {label}", text + begins)

    def _code(self, value: Any) -> str | None:
        """Follow a function, class or module, and return what stands for it; None for anything else."""
        if isinstance(value, ModuleType):
            if self._is_users(value.__name__):
                self._module(value)  # which need not be among those that Python knows
                self._follow(self._whole, value)
            return f"module {value.__name__}"
        if isinstance(value, type):
            # What a library has made of the user's is not in its module; in C the name of that may be a descriptor.
            module = value.__module__ if isinstance(value.__module__, str) else "builtins"
            if self._is_users(module) or not hasattr(sys.modules.get(module), value.__qualname__.partition(".")[0]):
                self._follow(self._class, value)
            self.classes[label_of(value)].add(id(value))
            return f"class {self._label(value)}"
        if type(value) is FunctionType:  # not a proxy of one
            self._called.add(value.__name__)
            self._follow(self._function, value)
            return f"function {self._label(value)}"
        return None

    def _label(self, value: Any) -> str:
        """Return the name of a function or class, with a number where others have the same, such as closures."""
        known = self._alike[label := label_of(value)]
        number, _ = known.setdefault(id(value), (len(known), value))
        return f"{label} {number + 1}" if number else label

    def _form(self, value: Any, known: dict[int, tuple[Any, str]]) -> str:
        """Return the canonical form of a value, the same in all processes, and follow the code in it.

        ``known`` has the objects of the value that have been met, and the form of each, or its number.
        """
        kind = type(value)
        if kind in PATHS:
            value = kind(self._placed(str(value)))
        if kind in PLAIN:
            return repr(value)
        if (code := self._code(value)) is not None:
            return code
        if id(value) in known:
            return known[id(value)][1]
        # Objects may refer to each other in a circle: inside it, one stands for itself by its number.
        number = f"object {len(known)}"
        known[id(value)] = value, number
        try:
            forms = [self._form(one, known) for one in self._pieces(value)]
            inside = without_package(", ".join(sorted(forms) if kind in (set, frozenset) else forms))
            # Digested where it is long: objects that share parts would else repeat their text at each level.
            text = f"{self._label(kind)} [{inside if len(inside) < LONGEST else digest_of(inside)}]"
        except Exception:  # whatever keeps an object from being taken apart; also where it is too deep
            self.unnoticed[self._value] = text = self._label(kind)
            self._is_partial = True
        # What is there twice and can be changed is not the same as two that are equal.
        known[id(value)] = value, number if isinstance(value, CHANGEABLE) else text
        return text

    def _placed(self, text: str) -> str:
        """Return a path as it is seen from the nearest module that has more than the root in common with it."""
        if text[:1] != os.sep or text.startswith(tuple(self.written)):
            return text
        near = [one for one in self.folders if os.path.commonpath((one[0], text)) != os.sep]
        seen = [(os.path.relpath(text, folder), name) for folder, name in near]
        return "{} from {}".format(*min(seen, key=lambda one: (one[0].count(".."), one))) if seen else text

    def _pieces(self, value: Any) -> Iterable[Any]:
        """Return what makes an object, without what code changes; raises any exception where that is not known."""
        import cloudpickle  # which takes apart what pickle cannot

        kind = type(value)
        if kind in (set, frozenset):  # in an order that is the same in all processes, so that numbers of functions are
            return sorted(value, key=_contents)
        if kind in (list, tuple, dict):
            return chain.from_iterable(value.items()) if kind is dict else iter(value)
        if kind is np.ndarray and value.dtype.kind not in "OV":
            strides = () if value.flags.c_contiguous else value.strides  # sums and views depend on them
            return value.dtype.str, value.shape, strides, digest_of(value.tobytes())
        # A wrapper of a library, whose other attributes may be caches.
        is_other = kind is not value.__class__ or distributions_of(kind.__module__) is not None
        wraps = is_other and callable(value) and hasattr(value, "__wrapped__") and "__wrapped__" not in vars(kind)
        if isinstance(value, DESCRIPTORS) or (wraps and kind not in (MethodType, partial)):
            return [getattr(value, name, None) for name in WRAPPED]
        is_made = kind is np.ufunc and "vectorized" in value.__name__  # by frompyfunc, which does not tell of what
        is_unsteady = isinstance(value, UNSTEADY) or (is_other and isinstance(value, Iterator))
        if is_unsteady or value is os.environ or is_made or kind.__module__.startswith(ELSEWHERE):
            raise TypeError("not the same from call to call")
        reduce = cloudpickle.Pickler.dispatch_table.get(kind) if kind is not TypeVar else None  # by its whole module
        reduced = reduce(value) if reduce is not None else value.__reduce_ex__(4)
        if is_other and kind is not partial and all(hasattr(kind, name) for name in ("func", "args", "keywords")):
            reduced = kind, (value.func, value.args, value.keywords)  # toolz pickles names of these, and docstrings
        if isinstance(value, ctypes.CDLL):  # of which all else are addresses
            reduced = kind, (digest_of(Path(value._name).read_bytes()),)
        if isinstance(reduced, str):  # to be found in its module
            self._is_users(getattr(value, "__module__", None) or kind.__module__)
            if is_other:
                return reduced, *(getattr(value, name) for name in MEANT if hasattr(value, name))
            reduced = reduced, (kind,), object.__getstate__(value)
        function, args, state, items, pairs = (*reduced, None, None, None)[:5]
        states = state if isinstance(state, tuple) else (state,)  # __dict__ and slots
        if not is_other:  # also before the first call
            self._is_partial |= not self._changed.isdisjoint(f"{base.__name__}." for base in kind.__mro__)
            pickling = [getattr(kind, name) for name in ("__getstate__", "__reduce__", "__reduce_ex__")]
            users = [one for one in pickling if type(one) is FunctionType and distributions_of(one.__module__) is None]
            self._is_hiding |= bool(reduce or users)
        kept = [self._kept(kind, one) if isinstance(one, dict) else one for one in states]
        return function, args, *kept, list(items or ()), list(pairs or ())

    def _kept(self, kind: type, state: dict[Any, Any]) -> list[Any] | None:
        """Return the attributes of an object that neither code changes nor are caches, in order; None if there is
        none, as before anything was cached.
        """
        cached = {key for key in state if isinstance(getattr(kind, str(key), None), cached_property)}
        if distributions_of(kind.__module__) is not None:  # as of pandas, and of xarray, which makes empty ones late
            cached |= {"_cache", *(name for name in ("_attrs", "_encoding") if not state.get(name))}
        changed = state.keys() & self._changed
        self._is_partial |= bool(changed - cached)
        return [(key, state[key]) for key in sorted(state.keys() - changed - cached - {"__doc__"}, key=str)] or None

    def _is_users(self, module: str | None) -> bool:
        """Return whether a module is the user's; count what it does while it is imported, or its distributions."""
        if (distributions := distributions_of(module)) is not None:
            for name in distributions:
                self._keep(f"package {name}", version_of(name))
        elif isinstance(there := sys.modules.get(module or ""), ModuleType):  # a module may put another object there
            self._module(there)
        return distributions is None

    def _module(self, module: ModuleType) -> None:
        """Add what the user's module, and those that it imports, do to others meanwhile, in the order of import."""
        name, file, acts = module.__name__, getattr(module, "__file__", None) or "", list[Any]()
        if name in self.modules:
            return
        self.modules[name] = module
        self._is_users(getattr(vars(module).get("__spec__"), "name", name).rpartition(".")[0])  # its package is first
        if file.endswith(tuple(EXTENSION_SUFFIXES)):
            self._keep(f"file {Path(file).name}", digest_of(Path(file).read_bytes()))
        tree = tree_of(file, vars(module))
        self.written.update(_index(tree)[os.sep])
        if _index(tree)[PLACES]:
            self.folders |= {(os.path.dirname(one), name) for one in (os.path.abspath(file), os.path.realpath(file))}
        for one in tree.body:
            self._imports(_at_import(one), vars(module))
            if _is_act(one, vars(module)):
                acts.append(one)
                self.acting += [name] if self.acting[-1:] != [name] else []
        for one in (one for one in acts if isinstance(one, DEFINITIONS)):  # so that a message can name it
            self._code(vars(module).get(one.name))
        self._keep(f"module {name}", self._text(acts, vars(module)))

    def _whole(self, module: ModuleType) -> None:
        shell = getattr(sys.modules.get("IPython"), "get_ipython", bool)()
        entered = getattr(shell, "user_ns_hidden", {})  # In, Out and others, which grow with each cell
        for name, value in sorted(vars(module).items()):
            if (not name.startswith("__") or name == "__getattr__") and entered.get(name, entered) is not value:
                self._named(name, vars(module), value)

    def _named(self, name: str, names: Names, value: Any) -> str:
        """Follow what a module has under a name, as `_refer`, wherever it is imported from."""
        name, names = home_of(name, names, value)
        if not self._is_users(names.get("__name__")):  # what a library has besides code, such as a table, is its own
            return self._code(value) or ""
        # IPython takes the name of a module from what %run has executed.
        return self._refer(without_package(f"{names.get('__name__', MAIN[0])}.{name}"), value, names)

    def _function(self, function: FunctionType) -> None:
        """Add a function, and what it changes while it runs."""
        names, label, code = function.__globals__, self._label(function), function.__code__
        if not self._is_users(names.get("__name__")):
            # A wrapper that a library made may hold an object of the user's, or a number; other things that it holds,
            # such as the cache of a single dispatch, change when it is called; so do numbers in those of Python.
            self._value, kept = "", list[str]()
            plain = PLAIN if distributions_of(names.get("__name__")) else ()
            for name, one in chain(_closure(function).items(), vars(function).items()):
                form, thing = self._form(one, {}), one.__self__ if type(one) is MethodType else one
                is_plain = type(one) in plain and name[:1] != "_"  # else perhaps a cache, as in networkx
                kept += [form] if is_plain or distributions_of(type(thing).__module__) is None else []
            self._keep(f"function {label}", ", ".join(kept))
            return
        # what attrs makes has numbers in its source that differ from process to process; fields are in the class
        nodes = [] if "<attrs generated" in code.co_filename else list[Any](definitions_of(function))
        values = function.__defaults__ or ()
        by_name = dict(zip(code.co_varnames[code.co_argcount - len(values) :], values, strict=False))
        by_name |= {name: value for name, value in vars(function).items() if not name.startswith("__")}
        text = "".join(self._refer(f"{label}.{k}", v) for k, v in (by_name | (function.__kwdefaults__ or {})).items())
        closed = {k: v for k, v in _closure(function).items() if not k.strip("_").endswith("HAS_DEFAULT_FACTORY")}
        text += "".join(self._refer(f"{k} of {label}", v, names) for k, v in closed.items())
        if nodes:
            self.places[f"function {label}"] = f"{code.co_filename}, line {nodes[0].lineno}"
            inside = {inner for node in nodes for inner in ast.walk(node)}
            ran, owner = inside.difference(*map(_at_import, nodes)), function.__qualname__.split(".")[-2:][0]
            calls = [unparsed(one.func).rpartition(".")[2] for one in ran if isinstance(one, ast.Call)]
            self._called |= _all_names(code) | {f"{owner if re.match(ITSELF, one) else one}()" for one in calls}
            if self._is_running and "__subclasses__" in code.co_names:  # also those of the classes before
                self._todo += [one for one in self._todo if one[1] == self._class]
            if (name := function.__name__) not in MAKING_CLASSES:
                imported = {node.name for node in inside if isinstance(node, ast.alias)}
                others = imported.union(_names_in((*nodes,), code), code.co_freevars)
                scopes = [node for node in inside if isinstance(node, ast.Global | ast.Nonlocal)]
                changes = {(one, "") for node in scopes for one in node.names}
                for one in _changed(inside):  # what makes an object changes only those of others, and its class
                    root, is_set = one.partition(".")[0], "." in one
                    is_set &= name not in MAKING or bool(re.match(ITSELF, one.removeprefix("self.")))
                    is_other = is_set or root in others  # else perhaps what a parameter is by default
                    changes.add((one.rpartition(".")[2] if is_other else f"{label}.{one}", ""))
                    if is_set and root in (*code.co_varnames[:1], *others):  # also before it has the attribute
                        changes.add((owner if root in code.co_varnames[:1] else root, "."))
                homes = {home_of(one, names, names.get(one))[0] + end for one, end in changes}
                self._changes.append((f"{owner}()" if name in MAKING else name, homes))
        elif not function.__name__.startswith("__"):  # what dataclasses make is in their class already
            self.unnoticed[self._through or label] = "function without source"
            literals = [one for inner in _inside(code) for one in inner.co_consts if type(one) in (*PLAIN, tuple)]
            nodes = [ast.Constant(one) for one in literals if one != function.__doc__]
            nodes += [ast.Name(name) for name in sorted(_all_names(code))]  # what it reaches counts
        text += self._text(nodes, names, function)
        self._keep(f"function {label}", text)

    def _class(self, cls: type) -> None:
        """Add the statements of a class, and all that it has now."""
        label, names = self._label(cls), getattr(sys.modules.get(cls.__module__), "__dict__", {})
        below = type.__subclasses__(cls) if "__subclasses__" in self._called else list[type]()
        text = str([self._code(one) for one in (*cls.__mro__[1:], type(cls), *below)])
        # Methods count as functions, so that a message can name them; all else as it is now, also if it was set later.
        file = names.get("__file__") or ""
        for name, value in sorted(vars(cls).items()):  # in an order that does not depend on that of definitions
            for inner in self._pieces(value) if isinstance(value, DESCRIPTORS) else [value]:
                # What makes annotations, in Python 3.14, has all names of the class; they are in its statements.
                if isinstance(inner, FunctionType) and not name.startswith("__annotate"):
                    self._follow(self._function, inner)
                    file = file or inner.__code__.co_filename  # the cell of a notebook
                elif not isinstance(inner, NOTHING) and (name == "__orig_bases__" or not name.startswith(PYTHONS)):
                    text += self._refer(f"{label}.{name}", inner)
        index = _index(tree_of(file, names))
        nodes = index[f"class {cls.__name__}"]
        for node in nodes or index[cls.__name__][:1]:  # a class that is made by a call
            self.places[f"class {label}"] = f"{file}, line {node.lineno}"
        for name in {"__match_args__", "__pydantic_fields__"}.intersection([] if nodes else vars(cls)):  # in a notebook
            text += self._refer(f"{label}.{name}", vars(cls)[name])
        for node in nodes:
            members = [one for one in node.body if not isinstance(one, DEFINITIONS)] or [ast.Pass()]
            alone = {**dict(ast.iter_fields(node)), "bases": [], "keywords": [], "body": members}
            text += self._text([ast.ClassDef(**alone)], names)
        self._keep(f"class {label}", text)

    def _text(self, nodes: Sequence[ast.AST], names: Names, function: FunctionType | None = None) -> str:
        """Return some code of a module with these names, or of a function, with what the names in it stand for, and
        follow these: globals, what it imports, and attributes of modules.
        """
        if function is None and self._is_running:  # runs while it is imported, before any root is called
            return ""
        bound, code = self._imported(nodes, names), function.__code__ if function else None
        text = "".join(map(unparsed, nodes))
        # _C__k, which is __k in the class C
        private = {name for name in _all_names(code) if re.match("_[^_].*__", name)}
        # Of a decorator what it has made is followed; what a library keeps of a number in an object is not known.
        is_inner = code is None or "<" in code.co_qualname  # whose decorators have names of what is around it
        decorators = [one for node in nodes for one in getattr(node, "decorator_list", ()) if not is_inner]
        numbers = {n for one in decorators for n in _chains(one) if type(names.get(n)) in PLAIN and n in names}
        wanted = numbers | {n for n in (*bound, *private, *_names_in((*nodes,), code)) if n in bound or n in names}
        scope = ChainMap(bound, names, vars(builtins), {"sys": sys})  # which it may import inside
        for whole in sorted(private.union(*map(_chains, nodes))):
            first, *path = whole.split(".")
            value, name, home = scope.get(first), first, names
            with suppress(Exception):  # raised again by the function where it is called
                while path and isinstance(value, ModuleType):
                    home, name = vars(value), path.pop(0)
                    value = getattr(value, name)
            if function and any(value is one for one in BY_NAME) and names.get("__name__") in sys.modules:
                self._follow(self._whole, sys.modules[names["__name__"]])
            if first not in wanted:
                continue
            stands = self._named(name, home, value)
            text += f" {whole} {stands}" if stands else ""
        return text

    def _imported(self, nodes: Iterable[ast.AST], names: Names) -> dict[str, Any]:
        """Return what the import statements in some code bind; what is not the user's is not imported for this."""
        bound, package = dict[str, Any](), names.get("__package__")
        inside = [one for node in nodes for one in ast.walk(node)]
        called = [one.asname for one in inside if isinstance(one, ast.alias) and one.name == "import_module"]
        called += [n.id for n in inside if isinstance(n, ast.Name) and names.get(n.id) is importlib.import_module]
        ends = "import_module", "__import__", *map(".{}".format, called)
        for one in inside:
            with suppress(Exception):  # raised again by the function where it is called
                if isinstance(one, IMPORTS):
                    if True in [self._is_users(module.partition(".")[0]) for module, _ in imports_in([one], package)]:
                        exec(unparsed(one), {"__package__": package}, bound)
                elif isinstance(one, ast.Call) and f".{unparsed(one.func)}".endswith(ends):
                    named = [*one.args, *(each.value for each in one.keywords if each.arg == "name")][0]
                    name = importlib.util.resolve_name(ast.literal_eval(named), package)
                    self._code(importlib.import_module(name) if self._is_users(name) else None)
        self._imports(inside, names)
        return bound

    def _imports(self, nodes: Iterable[ast.AST], names: Names) -> None:
        """Follow the user's modules that some code imports, for what they do meanwhile."""
        for module, alias in imports_in(nodes, names.get("__package__")):
            for name in (module, f"{module}.{alias.name}"):
                if distributions_of(name) is None:
                    self._is_users(name)


def imports_in(nodes: Iterable[ast.AST], package: str | None) -> Iterator[tuple[str, ast.alias]]:
    """Yield the names that some code of a package imports, each with the module that it is, or is from."""
    for node in (node for node in nodes if isinstance(node, IMPORTS)):
        base = f"{'.' * node.level}{node.module or ''}" if isinstance(node, ast.ImportFrom) else ""
        with suppress(ImportError):  # raised again where it is executed
            yield from [(importlib.util.resolve_name(base or alias.name, package), alias) for alias in node.names]


def home_of(name: str, names: Names, value: Any, hops: int = 9) -> tuple[str, Names]:
    """Return the name and the module's names under which a value is bound that a module has, perhaps from others."""
    if hops and distributions_of(names.get("__name__")) is None:
        index = _index(tree_of(names.get("__file__") or "", names))
        for module, alias in imports_in(index[ast.ImportFrom], names.get("__package__")):
            original = name if alias.name == "*" and not index[name] else alias.name
            there = getattr(sys.modules.get(module), "__dict__", {})
            if name == (alias.asname or original) and there.get(original, index) is value:
                return home_of(original, there, value, hops - 1)
    return name, names


def _closure(function: FunctionType) -> dict[str, Any]:
    """Return the names in a function's closure with their values."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {name: cell.cell_contents for name, cell in cells if cell != CellType()}  # this one is not filled yet


def _contents(value: Any, depth: int = 4) -> str:
    """Return what tells a value from others: functions by what is in their closures, objects by their attributes."""
    inside = _closure(value) if type(value) is FunctionType else getattr(value, "__dict__", {})
    parts = [*inside.values(), *getattr(value, "args", ())] if depth else []
    more = [_contents(one, depth - 1) for one in parts if callable(one)]
    text = re.sub(r" at 0x\w+", "", f"{value!r} {inside!r} {more}")
    words = sorted(re.split(r"\W+", text))  # sets among them have no order
    return f"{words} {text}"


def tree_of(filename: str, names: Names) -> ast.Module:
    """Return the syntax tree of the file, cell or argument that some code is from; empty where there is no source."""
    if TREE in names and filename == names["__file__"]:
        return names[TREE]  # type: ignore[no-any-return]
    linecache.checkcache(filename)
    return _parsed("".join(linecache.getlines(filename, dict(names))))


@lru_cache(maxsize=256)
def _parsed(text: str) -> ast.Module:
    try:
        return without_docstrings(ast.parse(text))
    except SyntaxError:  # a cell with commands of IPython
        return ast.Module([], [])


def without_docstrings(tree: ast.Module) -> ast.Module:
    """Return a tree, changed in place, without docstrings and texts in place of comments."""
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            body[:] = [one for one in body if not _is_text(one)] or [ast.Pass()]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(getattr(statement.value, "value", None), str)


def definitions_of(function: FunctionType) -> Sequence[Function]:
    """Return the definition of a function; of a lambda perhaps all in its line, none where there is no source.

    Raises SweepError where its file has changed since it was imported: what it computes is no longer what is there.
    """
    code, names = function.__code__, function.__globals__
    line = code.co_firstlineno
    # Only files that are younger than this process are compared: code objects of others may differ from those that
    # are compiled here, as pytest and coverage change what they import.  A cell of a notebook has no file.
    with suppress(OSError):
        if TREE not in names and os.stat(code.co_filename).st_mtime > _BEGAN:
            if not (lines := _lines_of(Path(code.co_filename).read_bytes()).get(_unplaced(code))):
                why = "has changed since it was imported: import it again, or start a new session"
                raise SweepError(why, code.co_filename)
            line = line if line in lines else lines[0]  # a notebook that reloads compiles a function by itself
    nodes = _index(tree_of(code.co_filename, names))[line, code.co_name]
    places = {*code.co_positions()}  # the whole of a lambda is often that of its last operation
    return [one for one in nodes if isinstance(one, ast.Lambda) and _place_of(one.body) in places] or nodes


@lru_cache(maxsize=64)
def _lines_of(text: bytes) -> Mapping[CodeType, list[int]]:
    """Return the lines in which each code of a file begins."""
    lines = defaultdict[CodeType, list[int]](list)
    for code in _inside(compile(text, "", "exec", dont_inherit=True)):
        lines[_unplaced(code)].append(code.co_firstlineno)
    return lines


def _unplaced(code: CodeType) -> CodeType:
    inner = tuple(_unplaced(one) if isinstance(one, CodeType) else one for one in code.co_consts)
    return code.replace(co_consts=inner, co_firstlineno=1, co_linetable=b"", co_flags=0)


def _inside(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _inside(constant)


@lru_cache(maxsize=4096)
def _names_in(nodes: tuple[ast.AST, ...], code: CodeType | None) -> frozenset[str]:
    """Return the names that statements of a module look up in it, or functions of which this is the compiled code; what
    a class looks up it may have bound itself.
    """
    text = "\n".join(map(_with_generators, nodes))  # not the instructions, which versions of Python make differently
    text = f"def around({', '.join(code.co_freevars)}):\n pass\n{indent(text, ' ')}" if code else text
    top = symtable.symtable(text, "", "exec")
    top = top.get_children()[-1] if code else top  # after what Python 3.14 has for annotations
    names = {one.get_name() for one in top.get_symbols() if one.is_referenced()}
    if code is not None:  # also in defaults and annotations: what code changes of a default is left out of its value
        is_inner = "<" in code.co_qualname  # whose defaults may have names of what is around it
        parts = [getattr(node, "args", node) for node in nodes if not (is_inner and hasattr(node, "args"))]
        names &= {n.id for node in parts for n in ast.walk(node) if isinstance(n, ast.Name)}
    tables = [*top.get_children()]
    for table in tables:  # which grows meanwhile
        binds = code and table.get_type() == "class"  # what it may have looked up before
        names |= {one.get_name() for one in table.get_symbols() if one.is_global() or (binds and one.is_referenced())}
        tables += table.get_children()
    return frozenset(names)


class _Generators(ast.NodeTransformer):
    """Makes generators of comprehensions, whose names Python 3.12 and later does not keep apart from those around."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Return what is to stand for a node."""
        super().generic_visit(node)
        if isinstance(node, ast.ListComp | ast.SetComp):
            return ast.GeneratorExp(node.elt, node.generators)
        if isinstance(node, ast.DictComp):
            return ast.GeneratorExp(ast.Tuple([node.key, node.value], ast.Load()), node.generators)
        return node


def _with_generators(node: ast.AST) -> str:
    text = unparsed(node)
    return ast.unparse(_Generators().visit(ast.parse(text))) if "for" in text else text


def _all_names(code: CodeType | None) -> set[str]:
    return {name for one in _inside(code) for name in one.co_names} if code else set()


@lru_cache(maxsize=256)
def _index(tree: ast.Module) -> Mapping[Any, list[Any]]:
    """Return functions by the line that they begin in, decorators included, and their name; classes by theirs; and the
    other statements of a module by the names in them, and its absolute paths.
    """
    index: dict[Any, list[Any]] = defaultdict(list)
    for node in ast.walk(tree):
        if isinstance(node, Function):
            first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            index[first, getattr(node, "name", "<lambda>")].append(node)
        elif isinstance(node, ast.ClassDef):
            index[f"class {node.name}"].append(node)
        elif isinstance(node, ast.ImportFrom):
            index[ast.ImportFrom].append(node)
        elif getattr(node, "id", getattr(node, "attr", "")) in PLACES:
            index[PLACES].append(node)
        elif isinstance(text := getattr(node, "value", None), str) and len(text) > 1 and text[0] == os.sep:
            index[os.sep].append(text)
    for one in (one for one in tree.body if not isinstance(one, DEFINITIONS)):
        nodes = [node for node in ast.walk(one) if isinstance(node, ast.Name | ast.alias)]
        for name in {node.id if isinstance(node, ast.Name) else node.asname or node.name for node in nodes}:
            index[name].append(one)
    return index


@lru_cache(maxsize=4096)
def _chains(node: ast.AST) -> frozenset[str]:
    """Return the names in some code, each with the attributes that are taken of it: ``a``, ``a.b.c``."""
    parts = [one for one in ast.walk(node) if isinstance(one, ast.Name | ast.Attribute)]
    inner = {id(one.value) for one in parts if isinstance(one, ast.Attribute)}
    chains = {unparsed(one) for one in parts if id(one) not in inner}
    return frozenset(chain for chain in chains if re.fullmatch(r"[\w.]+", chain))


def _changed(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield what some code changes, as it names it: that of which it sets an attribute (``a.b``) or an item, or calls a
    method that changes its object (``a``).
    """
    for one in nodes:
        whole: ast.AST = one
        if isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr in CHANGING:
            whole = one.func.value
        elif not isinstance(one, ast.Attribute | ast.Subscript) or isinstance(one.ctx, ast.Load):
            continue
        while isinstance(whole, ast.Subscript):
            whole = whole.value
        yield unparsed(whole)


def _is_act(statement: ast.stmt, names: Names) -> bool:
    """Return whether a statement of a module with these names acts on others while that is imported: changes them,
    calls what may, or defines what a decorator gives to them.  A script goes on after a run: only what it changes of
    modules, and what it has defined, is more than its own affair.
    """
    nodes = _at_import(statement)
    members = {one for each in nodes if isinstance(each, ast.ClassDef) for one in each.body}
    if any(isinstance(one, DEFINITIONS) and one not in members and _is_registered(one, names) for one in nodes):
        return True
    if names.get("__name__") in MAIN:
        # functions of modules are no methods
        return any(isinstance(names.get(one.partition(".")[0]), ModuleType) for one in _changed(nodes) if "." in one)
    calls = [one for one in nodes if isinstance(one, ast.Expr) and not isinstance(one.value, ast.Constant)]
    return bool(calls or [*_changed(nodes)])


@lru_cache(maxsize=4096)
def _at_import(statement: ast.AST) -> Sequence[ast.AST]:
    """Return what is executed of some code while its module is imported: not the bodies of functions, and not what only
    a script does or a type checker reads.
    """
    if isinstance(statement, ast.If) and re.search("__name__|TYPE_CHECKING", unparsed(statement.test)):
        return []
    runs = ast.iter_child_nodes(statement)
    if isinstance(statement, Function):
        runs = chain(getattr(statement, "decorator_list", ()), [statement.args])
    return [statement, *chain.from_iterable(map(_at_import, runs))]


def _is_registered(node: Any, names: Names) -> bool:
    """Return whether a decorator, or the hook of a base class, registers a definition somewhere: one that returns the
    function or class as it was, without a mark on it, or nothing, can have done nothing else.  Those of Python make
    definitions, and what a value of the user's is given is in that value.
    """
    value = names.get(node.name)
    is_kept = value is None or (isinstance(value, FunctionType | type) and value.__name__ == node.name)
    if not is_kept or any(mark not in unparsed(node) for mark in getattr(value, "__dict__", {}).keys() - PLAIN_CLASS):
        return False
    hooked = [one for one in getattr(value, "__mro__", ())[1:] if "__init_subclass__" in vars(one)]
    if any(distributions_of(one.__module__) is None for one in hooked):
        return True
    for whole in {whole for one in node.decorator_list for whole in _chains(getattr(one, "func", one))}:
        root = names.get(name := whole.partition(".")[0])
        home = vars(root) if isinstance(root, ModuleType) else home_of(name, names, root)[1]
        distributions = distributions_of(home.get("__name__"))
        if distributions or (distributions is None and isinstance(root, ModuleType | FunctionType | type)):
            return True
    return False


# Where code is found, and how it comes to other processes


class LocalFiles(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """A file by its absolute ``path`` with the modules of its folder that it imports, directly or through others,
    wherever the import statements are: their ``contents`` by their relative paths.

    They are modules of a package of their own, which is named after their content.  Import statements in them name that
    package where they name one of them: so versions of a file, and files of one name in two folders, exist beside each
    other.  They are loaded without bytecode, which Python takes by the second and the size of a file.
    """

    def __init__(self, path: Path) -> None:
        """Read the files; raises SweepError where there is none, and OSError where one cannot be read."""
        if not path.exists():
            raise SweepError(f"there is no file {shown(str(path))}")
        self.path, self.contents, files = str(path), dict[str, bytes](), {path.stem: str(path)}
        # All that could be imported is read now, also by statements inside of functions: a file that changes during a
        # run must not mix its versions, and workers may not have it at all.
        for name in (todo := [path.stem]):
            self.contents[name] = content = Path(files[name]).read_bytes()
            for imported in _imported(name, files[name], content):
                stem = str(path.parent.joinpath(*imported.split(".")))
                beside = [stem + suffix for suffix in SUFFIXES if Path(stem + suffix).is_file()]
                if beside and imported not in files:
                    files[imported] = beside[0]
                    todo.append(imported)
        self.digest = digest_of(repr(sorted(self.contents.items())))
        self.package = PREFIX + digest_of(f"{path} {self.digest}")
        self.files = {f"{self.package}.{name}": file for name, file in files.items()}

    def module(self) -> ModuleType:
        """Return the module of the file, executed once; raises whatever it raises."""
        if self.package not in sys.modules:
            sys.meta_path.insert(0, self)
        return importlib.import_module(f"{self.package}.{Path(self.path).stem}")

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return how Python loads a module of the package; warn where one of its files is also imported by name."""
        local = self.files.get(f"{self.package}.{fullname}")
        if local and local == getattr(PathFinder.find_spec(fullname, path), "origin", ""):
            _warn(f"{local} is imported by name, too, and so there are two of what it defines: use MODULE:NAME")
        if (file := self.files.get(fullname)) is None:  # a folder with modules, or of others
            is_package = any(known.startswith(f"{fullname}.") for known in self.files)
            return ModuleSpec(fullname, None, is_package=True) if is_package else None
        loader = self if file.endswith(".py") else None  # Python's own
        inside: list[str] | None = [] if file.endswith("__init__.py") else None
        return importlib.util.spec_from_file_location(fullname, file, loader=loader, submodule_search_locations=inside)

    def get_resource_reader(self, fullname: str) -> Any:
        """Return how importlib.resources reads the files beside a module."""
        return SourceFileLoader(fullname, self.files[fullname]).get_resource_reader(fullname)

    def exec_module(self, module: ModuleType) -> None:
        """Execute a module of the package."""
        name, place = module.__name__.partition(".")[2], str(module.__file__)
        tree = ast.parse(self.contents[name], place)
        # A file random.py may import Python's module random, as it does where it is run as a script.
        itself = "" if place.endswith("__init__.py") else name
        local = {known.split(".")[1] for known in self.files} - {itself}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in [one for one in node.names if one.name.partition(".")[0] in local]:
                    top = alias.name.partition(".")[0]
                    if not alias.asname:  # "import a.b" loads a.b and binds a
                        node.names.append(ast.alias(f"{self.package}.{top}", top))
                    alias.name, alias.asname = f"{self.package}.{alias.name}", alias.asname or top
            elif isinstance(node, ast.ImportFrom) and not node.level and str(node.module).partition(".")[0] in local:
                node.module = f"{self.package}.{node.module}"
        code = compile(ast.fix_missing_locations(tree), place, "exec", dont_inherit=True)
        vars(module)[TREE] = without_docstrings(tree)
        exec(code, vars(module))


def _imported(name: str, file: str, content: bytes) -> Iterator[str]:
    """Yield what import statements in a module of a folder may name there."""
    nodes, package = list[ast.AST](), name if file.endswith("__init__.py") else name.rpartition(".")[0]
    with suppress(SyntaxError, ValueError, RecursionError):  # reported when the file is executed
        nodes = list(ast.walk(ast.parse(content))) if file.endswith(".py") else []
    for module, alias in imports_in(nodes, f".{package}"):
        parts = f"{module}.{alias.name}".strip(".").split(".")
        yield from accumulate(parts, "{}.{}".format) if parts[0] != OURS else ()


class Live:
    """A function or experiment as this process has it, with its ``parts``: see `code_of`."""

    def __init__(self, value: Callable[..., Any] | Experiment) -> None:
        self.value, self.reach = value, _reach(value)
        self.parts, self.digest, self.paths = self.reach.parts, _digest(self.reach.parts), sys.path
        self.acting = self.reach.acting
        self.name = value.name if isinstance(value, Experiment) else name_of(value)
        self.path = _importable(value) or f"{SESSION}:{self.name}-{self.digest}"

    @cached_property
    def pickled(self) -> bytes:
        """The function with what it reaches in this session; raises SweepError where it cannot be pickled."""
        file = io.BytesIO()
        try:
            _pickler(file).dump(self.value)
        except Exception as error:  # whatever keeps an object from being pickled
            raise SweepError(
                f"the function {self.name} cannot be sent to workers "
                f"({type(error).__name__}: {error}); use pool='threads' or pool='serial', or give it as 'FILE.py:NAME'"
            ) from error
        return file.getvalue()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state with the function pickled once; raises SweepError as `pickled`."""
        return {"pickled": self.pickled} | {k: v for k, v in vars(self).items() if k not in ("value", "reach")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, and the function from its bytes."""
        vars(self).update(state)
        # Where this session finds what the function imports when it is called.
        sys.path += [path for path in self.paths if path not in sys.path]
        for name in self.acting:
            importlib.import_module(name)
        self.value = pickle.loads(self.pickled)


def _pickler(file: io.BytesIO) -> pickle.Pickler:
    """Return a pickler of functions without caches."""
    import cloudpickle

    reducers: dict[type, Callable[[Any], Any]] = {
        # In Python 3.11 a cached property holds a lock, which has no pickle.
        cached_property: lambda value: (cached_property, (value.func,), {"attrname": value.attrname}),
        WeakKeyDictionary: lambda value: (WeakKeyDictionary, ()),
        # Pickle would look these up in a script or notebook, which workers do not have.
        ALIAS: lambda value: (partial(ALIAS, type_params=value.__type_params__), (value.__name__, value.__value__)),
        NewType: lambda value: (NewType, (value.__name__, value.__supertype__)),
        type(_warn): lambda value: (lru_cache(**value.cache_parameters()), (value.__wrapped__,)),
    }

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]
        dispatch_table: ClassVar = ChainMap(reducers, cloudpickle.Pickler.dispatch_table)

    return Pickler(file)


@dataclass(frozen=True)
class SourceFunction:
    """A user's function: found by its reference in whichever process calls it, and identified by its code.

    Calling it raises SweepError if the file is gone, or the code is not that with which it was loaded.
    """

    reference: str = field(compare=False)
    name: str
    digest: str

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return _function(self)(*arguments)


@lru_cache(maxsize=16)
def _function(wanted: SourceFunction) -> Any:
    if _digest(parts_of(wanted.reference)) != wanted.digest:
        raise SweepError(f"{wanted.reference}: its code is not that with which the study was read")
    return _find(wanted.reference)


class Code:
    """Loads the code that a study names, where ``check`` raises no SweepError for its reference: from its files as they
    are now (``afresh``), or as this session has it.
    """

    def __init__(self, check: Callable[[str], None] = lambda reference: None, afresh: bool = True) -> None:
        self.check, self.afresh = check, afresh

    def experiment(self, reference: str, folder: Path) -> Experiment:
        """Return the experiment at a reference; raises SweepError as `load_experiment`."""
        self.check(reference)
        return load_experiment(reference, folder, afresh=self.afresh)

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Return the function at a reference; raises SweepError as `load_experiment`."""
        self.check(reference)
        value = _find(reference, folder, afresh=self.afresh)
        _require(callable(value), "a function", reference, value)
        absolute = absolute_reference(reference, folder)
        return SourceFunction(absolute, absolute.rpartition(":")[2], _digest(parts_of(absolute)))


def load_experiment(
    reference: str, folder: Path | None = None, digest: str | None = None, afresh: bool = False
) -> Experiment:
    """Return the Experiment that a reference names, made from a plain function if need be; a file's path is relative to
    ``folder``.

    With a ``digest``, the code that was provided with this digest is used, if any, whatever the file holds now; with
    ``afresh``, files are read again.  Raises SweepError where the module, the file or the attribute does not exist or
    is something else.
    """
    value = _find(reference, folder, digest, afresh)
    _require(isinstance(value, Experiment) or callable(value), "an Experiment or a function", reference, value)
    if digest is None:  # before anything is written
        _read_by(value)
    return value if isinstance(value, Experiment) else experiment_of(value)


def _require(is_wanted: bool, wanted: str, reference: str, value: object) -> None:
    if not is_wanted:
        what, name = f"a {type(value).__name__}, not {wanted}", shown(reference.rpartition(":")[2])
        raise SweepError(f"{shown(reference)}: the module has {what}, at {name}")


def keep(function: Callable[..., Any] | Experiment) -> str:
    """Make a function available in this process, as it is now, by the reference that is returned."""
    return str(_remember(Live(function)).path)


def _importable(function: Callable[..., Any] | Experiment) -> str | None:
    """Return the reference by which a function can be imported anywhere, None for one of this session."""
    module, name = sys.modules.get(getattr(function, "__module__", None) or ""), getattr(function, "__qualname__", "")
    if module is None or module.__name__ in MAIN or getattr(module, name, None) is not function:
        return None
    file = getattr(module, "__file__", None) or ""
    is_beside = file.endswith(".py") and "." not in module.__name__ and distributions_of(module.__name__) is None
    return f"{Path(file).resolve() if is_beside else module.__name__}:{name}"


def _remember(code: Any) -> Any:
    parts_of.cache_clear()
    _codes[code.path, None] = _codes[code.path, code.digest] = code
    return code


def provide(code: "LocalFiles | Live") -> None:
    """Let this process load what another one has sent."""
    _codes[code.path, code.digest] = code


def sources_of(reference: str, digest: str | None = None) -> "LocalFiles | Live | None":
    """Return what another process needs to load a loaded reference; None where that is a module."""
    return _codes.get((reference, digest)) or _codes.get((reference.rpartition(":")[0], digest))


def source_digest(reference: str) -> str | None:
    """Return the digest of a loaded reference; None where that is a module."""
    return getattr(sources_of(reference), "digest", None)


# The modules of what is sent to workers, and of the values sent later, which are to have the same classes: workers may
# not have these modules, or not as they are in this session.
_by_value: dict[str, ModuleType] = {}


def sendable(reference: str, digest: str | None = None) -> "LocalFiles | Live | None":
    """Return what to send to a process that is to load a loaded reference; None where it can only import it itself.

    Raises SweepError for a function of this session that cannot be pickled.
    """
    import cloudpickle

    sources = sources_of(reference, digest)
    wanted = sources.reach.modules if isinstance(sources, Live) else {}
    for name in _by_value.keys() - wanted.keys():
        cloudpickle.unregister_pickle_by_value(_by_value.pop(name))
    for name in wanted.keys() - {*cloudpickle.list_registry_pickle_by_value(), "__main__"}:
        cloudpickle.register_pickle_by_value(_by_value.setdefault(name, wanted[name]))
    if isinstance(sources, Live):
        sources.pickled  # noqa: B018 (what can fail is done here, once)
    return sources


def absolute_reference(reference: str, folder: Path) -> str:
    """Return the reference as it works from any directory: a file's path is made absolute."""
    place, _, attribute = reference.rpartition(":")
    return f"{(folder / place).resolve()}:{attribute}" if place.endswith(".py") else reference


def _find(reference: str, folder: Path | None = None, digest: str | None = None, afresh: bool = False) -> Any:
    """Return the object that a reference names; raises SweepError where there is none."""
    absolute = absolute_reference(reference, folder or Path.cwd())
    place, _, attribute = absolute.rpartition(":")
    if not place or not attribute:
        raise SweepError(f"{shown(reference)}: must be MODULE:NAME or FILE.py:NAME")
    if afresh and place != SESSION:
        parts_of.cache_clear()
        for path in (absolute, place):
            _codes.pop((path, None), None)
    code = sources_of(absolute, digest)
    if isinstance(code, Live):
        return code.value
    if place == SESSION:
        name = shown(attribute.rpartition("-")[0])
        raise SweepError(f"the function {name} was defined in a script or notebook; run that, retry=True for failures")
    try:
        if place.endswith(".py"):
            module = (code or _remember(LocalFiles(Path(place)))).module()
        else:
            module = importlib.import_module(place)
    except SweepError as error:
        raise SweepError(error.problems, error.where and f"{reference}, {error.where}") from error
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        text = without_package(str(error))
        message = f"{type(error).__name__}{f': {text}' if text else ''}{_line_of(error)}"
        if isinstance(error, ImportError) and f"{place}.".startswith(f"{error.name or place}."):  # also if relative
            message += "; a function in a file is FILE.py:NAME; one of a package needs its folder in PYTHONPATH"
        raise SweepError(f"{shown(reference)}: cannot be imported: {message}") from error
    if not hasattr(module, attribute):
        hint = suggest(attribute, [name for name in vars(module) if not name.startswith("_")])
        raise SweepError(f"{shown(reference)}: the module has no attribute {shown(attribute)}{hint}")
    return getattr(module, attribute)


def _line_of(error: BaseException) -> str:
    """Return the file and line of a user's code at which an exception was raised, in brackets."""
    frames = [one for one in traceback.extract_tb(error.__traceback__) if one.filename.endswith(".py")]
    users = [one for one in frames if distributions_at(one.filename, Path(one.filename).stem) is None]
    return f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""


def file_of(reference: str) -> str:
    """Return the file that a reference names, or its module where there is none; imports nothing."""
    place = reference.rpartition(":")[0]
    spec = None if place.endswith(".py") else PathFinder.find_spec(place.partition(".")[0])
    return place if place.endswith(".py") else getattr(spec, "origin", None) or f"the module {place}"


def code_of(reference: str, experiment: Experiment, digest: str | None = None) -> dict[str, str]:
    """Return what determines the results of a loaded experiment besides its version, by kind and name: see `Reach`.

    Experiments that come with linksweep are identified by their own version alone.
    """
    place, parameters, code = reference.rpartition(":")[0], experiment.parameters, dict[str, str]()
    if place.partition(".")[0] != OURS or distributions_of(place) != ():
        digest = digest or source_digest(reference)
        code |= {**parts_of(reference, digest), **_contents_of(_find(reference, digest=digest))}  # as they are now
        code |= {f"default of {p.name}": json.dumps(p.written_default(), default=str) for p in parameters}
        code |= {f"default of {p.name}, an object": p.default.name for p in parameters if isinstance(p.default, Named)}
    packages = [name.removeprefix("package ") for name in code if name.startswith("package ")]
    return code | {f"package {name}": version_of(name) for name in (*packages, *experiment.packages)}  # of this process


@lru_cache(maxsize=64)  # the attributes of modules count as they are when a run starts
def parts_of(reference: str, digest: str | None = None) -> Mapping[str, str]:
    """Return the parts of what a loaded reference names, as `Reach` has them."""
    sources = sources_of(reference, digest)
    module = sources.module().__name__ if isinstance(sources, LocalFiles) else reference.rpartition(":")[0]
    return sources.parts if isinstance(sources, Live) else _reach(_find(reference, digest=digest), module).parts


def _reach(value: Any, module: str = "") -> Reach:
    """Return what a function or an experiment reaches; warn once of what has no canonical form."""
    roots = {"result": value}
    if isinstance(value, Experiment):
        roots = {one.name: getattr(value, one.name) for one in fields(value) if one.name not in DESCRIBING}
        roots |= {f"define of {p.name}": p.define for p in value.parameters if p.define is not None}
    reached = reach_of(roots, module)
    _places.update(reached.places)
    for name, kind in reached.unnoticed.items():
        _warn(f"changes of {name}, a {kind}, are not noticed")
    reached.parts.update(reached.statements)
    reached.parts.update(_contents_of(value))
    return reached


def defined_twice(reference: str, objects: Mapping[str, Iterable[Named]]) -> Iterator[tuple[str, str]]:
    """Yield the parameters of which an object is of another class of one name than those that a loaded reference has,
    with a phrase for it: the file of its module is loaded apart, or the cell of its class was executed again.
    """
    code = sources_of(reference)
    files = {*code.files.values()} if isinstance(code, LocalFiles) else set()
    apart = {n for n, one in sys.modules.items() if getattr(one, "__file__", "") in files and not n.startswith(PREFIX)}
    known = code.reach.classes if isinstance(code, Live) else {}
    if not apart and not known:
        return
    for parameter, one in [(name, one) for name, some in objects.items() for one in some]:
        reach = reach_of({"": one.value})
        if modules := sorted(apart & reach.modules.keys()):
            said = f"{one.name} is of the module {modules[0]}, which {reference} has loaded apart"
            yield parameter, f"{said}; give the function itself, and not its name"
        again = [name for name, ids in reach.classes.items() if ids.isdisjoint(known.get(name, ids))]
        if named := sorted(name for name in again if "<locals>" not in name):  # a function makes many of one name
            said = f"{one.name} is of another definition of the class {named[0]} than the function"
            yield parameter, f"{said}: make both anew"


def files_read(reference: str) -> dict[str, Path]:
    """Return the data files that a loaded reference declares, by name."""
    return _read_by(_find(reference))


def _read_by(value: Any) -> dict[str, Path]:
    """Return the data files that a function declares, by name; raises SweepError for one that is not there."""
    folder = Path(getattr(sys.modules.get(getattr(value, "__module__", "")), "__file__", None) or "x").parent
    files = {name: folder / name for name in getattr(getattr(value, ATTRIBUTE, None), "reads", ())}
    if missing := [name for name, file in files.items() if not file.is_file()]:
        raise SweepError(f"reads: {shown(missing[0])} is no file in {folder}", label_of(value))
    return files


def _contents_of(value: Any) -> dict[str, str]:
    return {f"file {name}": digest_of(file.read_bytes()) for name, file in _read_by(value).items()}


def _digest(parts: Mapping[str, str]) -> str:
    return digest_of(repr(sorted(parts.items())))


def new_process(code: str, **options: Any) -> "subprocess.Popen[bytes]":
    """Start a process of Python that finds modules where this one does, and not in the present folder if this one does
    not: it may be a stranger's.
    """
    around = {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    return subprocess.Popen([sys.executable, "-P", "-c", f"import linksweep; {code}"], env=around, **options)


def as_recorded_where_unsteady(now: Mapping[str, str], old: Mapping[str, str], reference: str) -> Mapping[str, str]:
    """Return the code of a reference as it is now, but with values that differ from process to process, such as a time,
    as an ``old`` version of it has them if they are made by the same statements.  Where only values differ, two new
    processes show which these are.
    """
    changed = [name for name in _differing(old, now) if not name.startswith(STATEMENT)]
    if not changed or reference.startswith(f"{SESSION}:") or not all(name.startswith("value ") for name in changed):
        return now
    edited = {name.replace(STATEMENT, "value ", 1) for name in _differing(old, now) - {*changed}}
    return {**now, **{name: old[name] for name in {*_unsteady(reference)} - edited if name in old}}


@cache
def _unsteady(reference: str) -> list[str]:
    code = f"import json; from linksweep.sweep.code import parts_of; print(json.dumps(parts_of({reference!r})))"
    processes = [new_process(code, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) for _ in range(2)]
    one, other = (json.loads((each.communicate()[0].splitlines() or [b"{}"])[-1]) for each in processes)
    for name in (differing := [name for name in one if name in other and one[name] != other[name]]):
        _warn(f"{name} differs from process to process; it counts by the statements that name it in its module")
    return differing


def _differing(old: Mapping[str, str], new: Mapping[str, str]) -> set[str]:
    return {name for name in {*old, *new} if old.get(name) != new.get(name)}


def code_differences(old: Mapping[str, str], new: Mapping[str, str], was: str, now: str) -> list[str]:
    """Return a phrase for each difference between two versions of code; ``was`` and ``now`` say where they are."""
    phrases = []
    for name in sorted(name for name in _differing(old, new) if not name.startswith(STATEMENT)):
        before, after = old.get(name, ""), new.get(name, "")
        how = "has changed" if DIGEST.search(f"{before} {after}") else f"is {before} {was}, {after} {now}"
        if not before or not after:
            how = f"is only {was if before else now}"
        owner = f"class {name.removeprefix('value ').rpartition('.')[0]}"  # of what a class has besides statements
        place = _places.get(name) or _places.get(owner)
        phrases.append(f"{name} ({place}) {how}" if place else f"{name} {how}")
    return phrases
