"""Finds a user's code by its reference, keeps code of this session under one, and brings it to other processes.

References are ``module:attribute``, ``path/to/file.py:attribute``, and ``session:NAME-DIGEST`` for a function that only
this session has.  A function that is given in Python is computed as this session has it, whatever its file holds.
"""

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import io
import itertools
import json
import logging
import os
import pickle
import re
import subprocess
import sys
import traceback
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, TypeVar
from weakref import WeakKeyDictionary

from linksweep.sweep.code import reach
from linksweep.sweep.code.reach import Reach, digest_of, distributions_of, version_of
from linksweep.sweep.contract import Experiment, SweepError, shown, suggest
from linksweep.sweep.functions.adapter import ATTRIBUTE, experiment_of, is_plain_function, name_of

# Our package, never looked for beside a user's file.
OURS = "linksweep"

# Stands in place of a module in the reference of a function that only this session has.
SESSION = "session"

EXTENSIONS = tuple(importlib.machinery.EXTENSION_SUFFIXES)
SUFFIXES = ("/__init__.py", *EXTENSIONS, ".py")  # as Python prefers them
DIGEST = re.compile("(^| )[0-9a-f]{12}( |$)")
# Fields of an experiment that its code does not depend on, or that count by themselves.
DESCRIBING = ("name", "version", "parameters", "outputs", "sample_outputs", "packages", "citation", "outer_draw")

log = logging.getLogger("linksweep")

AnyCode = TypeVar("AnyCode", "LocalFiles", "Live")

# Code by its path or reference and its digest, also what another process has sent: the file may be missing here, or be
# another. Without a digest: as this process has it now.
_codes: dict[tuple[str, str | None], "LocalFiles | Live"] = {}

_places: dict[str, str] = {}


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
        self.package = reach.PREFIX + digest_of(f"{path} {self.digest}")
        self.files = {f"{self.package}.{name}": file for name, file in files.items()}

    def module(self) -> ModuleType:
        """Return the module of the file, executed once; raises whatever it raises."""
        if self.package not in sys.modules:
            sys.meta_path.insert(0, self)
        return importlib.import_module(f"{self.package}.{Path(self.path).stem}")

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """Return how Python loads a module of the package."""
        if (file := self.files.get(fullname)) is None:  # a folder with modules, or of others
            is_package = any(known.startswith(f"{fullname}.") for known in self.files)
            return importlib.machinery.ModuleSpec(fullname, None, is_package=True) if is_package else None
        loader, inside = self if file.endswith(".py") else None, [] if file.endswith("__init__.py") else None
        return importlib.util.spec_from_file_location(fullname, file, loader=loader, submodule_search_locations=inside)

    def exec_module(self, module: ModuleType) -> None:
        """Execute a module of the package."""
        name, place = module.__name__.partition(".")[2], str(module.__file__)
        tree = ast.parse(self.contents[name], place)
        # A file random.py may import Python's module random, as it does where it is run as a script.
        own = "" if place.endswith("__init__.py") else name
        local = {known.split(".")[1] for known in self.files} - {own}
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
        vars(module)[reach.TREE] = reach.without_docstrings(tree)
        exec(code, vars(module))


def _imported(name: str, file: str, content: bytes) -> Iterator[str]:
    """Yield what import statements in a module of a folder may name there."""
    nodes, package = list[ast.AST](), name if file.endswith("__init__.py") else name.rpartition(".")[0]
    with suppress(SyntaxError, ValueError, RecursionError):  # reported when the file is executed
        nodes = list(ast.walk(ast.parse(content))) if file.endswith(".py") else []
    for node in (node for node in nodes if isinstance(node, reach.IMPORTS)):
        for module, alias in zip(reach.modules(node, f".{package}"), node.names, strict=False):
            parts = f"{module}.{alias.name}".strip(".").split(".")
            yield from itertools.accumulate(parts, "{}.{}".format) if parts[0] != OURS else ()


class Live:
    """A function or experiment as this process has it, with its ``parts``: see `code_of`."""

    def __init__(self, value: Callable[..., Any] | Experiment) -> None:
        self.value, self.reach = value, _reach(value)
        self.parts, self.digest, self.paths = self.reach.parts, _digest(self.reach), sys.path
        self.name = value.name if isinstance(value, Experiment) else name_of(value)
        self.path = _importable(value) or f"{SESSION}:{self.name}-{self.digest}"

    @cached_property
    def pickled(self) -> bytes:
        """The function with what it reaches in this session; raises SweepError where it cannot be pickled."""
        import cloudpickle

        registered = cloudpickle.list_registry_pickle_by_value()
        mine = [one for name, one in self.reach.modules.items() if name not in {*registered, "__main__"}]
        file = io.BytesIO()
        try:
            # By value, since workers may not have these modules, or not as they are in this session.
            for module in mine:
                cloudpickle.register_pickle_by_value(module)
            _pickler(file).dump(self.value)
        except Exception as error:  # whatever keeps an object from being pickled
            raise SweepError(
                f"the function {self.name} cannot be sent to workers "
                f"({type(error).__name__}: {error}); use pool='threads' or pool='serial', or give it as 'FILE.py:NAME'"
            ) from error
        finally:
            for module in mine:
                cloudpickle.unregister_pickle_by_value(module)
        return file.getvalue()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state with the function pickled once; raises SweepError as `pickled`."""
        return {"pickled": self.pickled} | {k: v for k, v in vars(self).items() if k not in ("value", "reach")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, and the function from its bytes."""
        vars(self).update(state)
        # Where this session finds what the function imports when it is called.
        sys.path += [path for path in self.paths if path not in sys.path]
        for name in self.parts:
            if name.startswith("module ") and name != "module __main__":  # acts on others while it is imported
                importlib.import_module(name.removeprefix("module "))
        self.value = pickle.loads(self.pickled)


def _pickler(file: io.BytesIO) -> pickle.Pickler:
    """Return a pickler of functions without caches."""
    import cloudpickle

    reducers: dict[type, Callable[[Any], Any]] = {
        # In Python 3.11 a cached property holds a lock, which has no pickle.
        cached_property: lambda value: (cached_property, (value.func,), {"attrname": value.attrname}),
        WeakKeyDictionary: lambda value: (WeakKeyDictionary, ()),
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
    value = _find(wanted.reference)
    if _digest(_reach(value)) != wanted.digest:
        raise SweepError(f"{wanted.reference}: its code is not that with which the study was read")
    return value


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
        return SourceFunction(absolute, absolute.rpartition(":")[2], _digest(_reach(value)))


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
    _require(isinstance(value, Experiment) or is_plain_function(value), "an Experiment or a function", reference, value)
    return value if isinstance(value, Experiment) else experiment_of(value)


def _require(is_wanted: bool, wanted: str, reference: str, value: object) -> None:
    if not is_wanted:
        what, name = f"a {type(value).__name__}, not {wanted}", shown(reference.rpartition(":")[2])
        raise SweepError(f"{shown(reference)}: the module has {what}, at {name}")


def keep(function: Callable[..., Any] | Experiment) -> str:
    """Make a function available in this process, as it is now, by the reference that is returned."""
    return _remember(Live(function)).path


def _importable(function: Callable[..., Any] | Experiment) -> str | None:
    """Return the reference by which a function can be imported anywhere, None for one of this session."""
    module, name = sys.modules.get(getattr(function, "__module__", None) or ""), getattr(function, "__qualname__", "")
    if module is None or module.__name__ == "__main__" or getattr(module, name, None) is not function:
        return None
    file = getattr(module, "__file__", None) or ""
    is_beside = file.endswith(".py") and "." not in module.__name__ and distributions_of(module.__name__) is None
    return f"{Path(file).resolve() if is_beside else module.__name__}:{name}"


def _remember(code: AnyCode) -> AnyCode:
    parts_of.cache_clear()
    _codes[code.path, None] = code
    provide(code)
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


def sendable(reference: str, digest: str | None = None) -> "LocalFiles | Live | None":
    """Return what to send to a process that is to load a loaded reference; None where it can only import it itself.

    Raises SweepError for a function of this session that cannot be pickled.
    """
    sources = sources_of(reference, digest)
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
        raise SweepError(f"{shown(reference)}: write module:attribute or file.py:attribute")
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
        text = reach.without_package(str(error))
        message = f"{type(error).__name__}{f': {text}' if text else ''}{_line_of(error)}"
        if isinstance(error, ImportError) and f"{place}.".startswith(f"{error.name or place}."):  # also if relative
            message += "; name a function of a package by its module, and put the package's folder in PYTHONPATH"
        raise SweepError(f"{shown(reference)}: cannot be imported: {message}") from error
    if not hasattr(module, attribute):
        hint = suggest(attribute, [name for name in vars(module) if not name.startswith("_")])
        raise SweepError(f"{shown(reference)}: the module has no attribute {shown(attribute)}{hint}")
    return getattr(module, attribute)


def _line_of(error: BaseException) -> str:
    """Return the file and line of a user's code at which an exception was raised, in brackets."""
    frames = [one for one in traceback.extract_tb(error.__traceback__) if one.filename.endswith(".py")]
    users = [one for one in frames if reach.distributions_at(one.filename, Path(one.filename).stem) is None]
    return f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""


def file_of(reference: str) -> str:
    """Return the file that a reference names, or its module where there is none; imports nothing."""
    place = reference.rpartition(":")[0]
    spec = None if place.endswith(".py") else importlib.machinery.PathFinder.find_spec(place.partition(".")[0])
    return place if place.endswith(".py") else getattr(spec, "origin", None) or f"the module {place}"


def code_of(reference: str, experiment: Experiment, digest: str | None = None) -> dict[str, str]:
    """Return what determines the results of a loaded experiment besides its version, by kind and name: see `Reach`.

    Experiments that come with linksweep are identified by their own version alone.
    """
    place, code = reference.rpartition(":")[0], dict[str, str]()
    if place.partition(".")[0] != OURS or distributions_of(place) != ():
        code |= parts_of(reference, digest or source_digest(reference))
        code |= {f"default of {p.name}": json.dumps(p.written_default(), default=str) for p in experiment.parameters}
    packages = {name for name in code if name.startswith("package ")} | {
        f"package {one}" for one in experiment.packages
    }
    return code | {name: version_of(name.removeprefix("package ")) for name in packages}  # of this process


@lru_cache(maxsize=64)  # the attributes of modules count as they are when a run starts
def parts_of(reference: str, digest: str | None = None) -> Mapping[str, str]:
    """Return the parts of what a loaded reference names, as `Reach` has them."""
    sources = sources_of(reference, digest)
    return sources.parts if isinstance(sources, Live) else _reach(_find(reference, digest=digest)).parts


def _reach(value: Any) -> Reach:
    """Return what a function or an experiment reaches; warn once of what has no canonical form."""
    roots = {"result": value}
    if isinstance(value, Experiment):
        roots = {one.name: getattr(value, one.name) for one in fields(value) if one.name not in DESCRIBING}
        roots |= {f"define of {p.name}": p.define for p in value.parameters if p.define is not None}
    reached = reach.reach_of(roots)
    _places.update(reached.places)
    for name, kind in reached.unnoticed.items():
        _warn(f"changes of {name}, a {kind}, are not noticed")
    folder = Path(getattr(sys.modules.get(getattr(value, "__module__", "")), "__file__", None) or "x").parent
    for name in getattr(getattr(value, ATTRIBUTE, None), "reads", ()):
        file = folder / name
        reached.parts[f"file {name}"] = digest_of(file.read_bytes()) if file.is_file() else "not there"
    return reached


@cache  # a process says it once
def _warn(sentence: str) -> None:
    log.warning("%s", sentence)


def _digest(reached: Reach) -> str:
    return digest_of(repr(sorted(reached.parts.items())))


def new_process(code: str, **options: Any) -> "subprocess.Popen[bytes]":
    """Start a process of Python that finds modules where this one does, and not in the present folder if this one does
    not: it may be a stranger's.
    """
    around = {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    return subprocess.Popen([sys.executable, "-P", "-c", f"import linksweep; {code}"], env=around, **options)


def code_differences(old: Mapping[str, str], new: Mapping[str, str], was: str, now: str) -> list[str]:
    """Return a phrase for each difference between two versions of code; ``was`` and ``now`` say where they are."""
    phrases = []
    for name in sorted(name for name in {*old, *new} if old.get(name) != new.get(name)):
        before, after = old.get(name, ""), new.get(name, "")
        how = "has changed" if DIGEST.search(f"{before} {after}") else f"is {before} {was}, {after} {now}"
        if not before or not after:
            how = f"is only {was if before else now}"
        phrases.append(f"{name} ({_places[name]}) {how}" if name in _places else f"{name} {how}")
    return phrases
