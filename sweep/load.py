"""Finds experiments and functions by their references, ``module:attribute`` or ``path/to/file.py:attribute``."""

import importlib
import sys
import sysconfig
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sweep.contract import Experiment, SweepError, shown
from sweep.functions.adapter import experiment_of, is_plain_function
from sweep.session import SESSION, SessionFunction, session_function
from sweep.session import provide as provide_function
from sweep.sources import INSTALLED, Sources, forget_module, make_module, read_sources

SOURCES = "__linksweep_sources__"
"""The attribute of a module made from a file that holds its `Sources`."""

_provided: dict[tuple[str, str], Sources] = {}
"""Sources that another process has sent, by path and digest: the file may be missing here, or have other content."""


def load_experiment(reference: str, folder: Path | None = None, digest: str | None = None) -> Experiment:
    """Return the Experiment that a reference names, made from a plain function if need be; a file's path is relative to
    ``folder``.

    With a ``digest``, the sources that were provided with this digest are used, if any, whatever the file holds now.
    Raises SweepError where the module, the file or the attribute does not exist or is something else.
    """
    own = session_function(reference)
    found = _find(reference, folder, digest)[1] if own is None else own.function
    if isinstance(found, Experiment):
        return found
    if not is_plain_function(found):
        raise _is_no("an Experiment or a function", reference, found)
    try:
        return experiment_of(found)
    except SweepError as error:
        raise SweepError(error.problems, f"{reference.rpartition(':')[2] if own is None else error.where}") from error


def read_experiment(reference: str, folder: Path) -> Experiment:
    """Return an Experiment as its file and local modules are now, whatever was loaded before; raises SweepError as
    `load_experiment`.
    """
    try:
        absolute = absolute_reference(reference, folder)
    except ValueError:  # not a path; loading it says so
        absolute = reference
    loaded = sources_of(absolute)
    if isinstance(loaded, Sources) and _read(Path(loaded.path)).digest != loaded.digest:
        forget(absolute)
    return load_experiment(reference, folder)


@dataclass(frozen=True)
class SourceFunction:
    """A user's function: found by its reference in whichever process calls it, and identified by the digest of its file
    and of the local modules that the file imports.

    Calling it raises SweepError if the file is gone or has changed since it was loaded.
    """

    reference: str = field(compare=False)
    name: str
    digest: str

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return _function(self)(*arguments)


def load_function(reference: str, folder: Path | None = None) -> SourceFunction:
    """Return the function that a reference names, as its file has it now; a file's path is relative to ``folder``.

    Raises SweepError as `load_experiment`, and for an object that cannot be called or has no Python file.
    """
    absolute = absolute_reference(reference, folder or Path.cwd())
    module, found = _find(absolute)
    digest = _digest(module)
    if SOURCES in vars(module) and digest != vars(module)[SOURCES].digest:  # a file that has changed since it was read
        forget(absolute)
        module, found = _find(absolute)
        digest = _digest(module)
    if not callable(found):
        raise _is_no("a function", reference, found)
    if digest is None:
        raise SweepError(f"{shown(reference)}: has no source file by which its code could be identified")
    return SourceFunction(absolute, absolute.rpartition(":")[2], digest)


@lru_cache(maxsize=16)
def _function(wanted: SourceFunction) -> Callable[..., Any]:
    found = load_function(wanted.reference)
    if found.digest != wanted.digest:
        raise SweepError(f"{wanted.reference}: its file is not the one that the study was read with")
    _, function = _find(wanted.reference)
    assert callable(function), "checked when it was loaded"
    return function


def _digest(module: ModuleType) -> str | None:
    """Return the digest of a module's source as it is now; None where it has no Python source."""
    path = getattr(module, "__file__", None)
    if path is None or not str(path).endswith(".py") or not Path(path).is_file():
        return None
    file = Path(path)
    return (read_sources(file) if SOURCES in vars(module) else Sources("", {"": file.read_bytes()})).digest


def _find(reference: str, folder: Path | None = None, digest: str | None = None) -> tuple[ModuleType, object]:
    """Return the module of a reference and the object that it names there, None if there is no such object."""
    place, colon, attribute = reference.rpartition(":")
    if not colon or not place or not attribute:
        raise SweepError(f"{shown(reference)}: write module:attribute or file.py:attribute")
    try:
        module = _module_of_file(place, folder, digest) if place.endswith(".py") else importlib.import_module(place)
        return module, getattr(module, attribute, None)
    except SweepError as error:
        if not error.where:
            raise
        raise SweepError(error.problems, f"{reference}, {error.where}") from error  # an error in a declaration
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        where = _line_of(error)
        text = error.msg if isinstance(error, SyntaxError) else str(error)
        message = f"{type(error).__name__}{f': {text}' if text else ''}"
        hint = _how_to_find(error, place, attribute)
        raise SweepError(f"{shown(reference)}: cannot be imported: {message}{where}{hint}") from error


def _how_to_find(error: BaseException, place: str, attribute: str) -> str:
    """Return a hint on how to name a function of a package that is not installed, '' for other errors."""
    if isinstance(error, ImportError) and "attempted relative import" in str(error):
        names = [Path(place).stem]
        folder = Path(place).absolute().parent
        while (folder / "__init__.py").is_file():
            names.insert(0, folder.name)
            folder = folder.parent
        if len(names) == 1:
            return ""
        return (
            f"; a file of a package is named by its module: PYTHONPATH={folder} sweep run {'.'.join(names)}:{attribute}"
        )
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing and f"{place}.".startswith(f"{missing}.") and Path(*place.split(".")).with_suffix(".py").is_file():
        return f"; it is not installed: PYTHONPATH={Path.cwd()} finds it here"
    return ""


def _line_of(error: BaseException) -> str:
    """Return the file and line of a user's code at which an exception was raised, in brackets."""
    if isinstance(error, SyntaxError) and error.filename:
        return f" ({error.filename}, line {error.lineno})"
    not_own = (str(Path(__file__).parent), sysconfig.get_path("stdlib"))
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename).is_absolute()]
    own = [f for f in frames if not f.filename.startswith(not_own) and not INSTALLED & set(Path(f.filename).parts)]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""


def _is_no(wanted: str, reference: str, found: object) -> SweepError:
    attribute = reference.rpartition(":")[2]
    kind = "has no attribute" if found is None else f"has a {type(found).__name__}, not {wanted}, at"
    return SweepError(f"{shown(reference)}: the module {kind} {shown(attribute)}")


def absolute_reference(reference: str, folder: Path) -> str:
    """Return the reference as it works from any directory: a file's path is made absolute."""
    place, _, attribute = reference.rpartition(":")
    return f"{(folder / place).resolve()}:{attribute}" if place.endswith(".py") else reference


def sources_of(reference: str, digest: str | None = None) -> Sources | SessionFunction | None:
    """Return the file and local modules of a loaded experiment as they were when they were loaded, or the function of a
    session; None for an experiment in a module.
    """
    place, _, _ = reference.rpartition(":")
    if place == SESSION:
        return session_function(reference)
    if not place.endswith(".py"):
        return None
    for key in (place, f"{place}@{digest}"):
        found: Sources | None = getattr(sys.modules.get(key), SOURCES, None)
        if found is not None and digest in (None, found.digest):
            return found
    return None


def source_digest(reference: str) -> str | None:
    """Return the digest of a loaded experiment's sources; None for an experiment in a module."""
    sources = sources_of(reference)
    return None if sources is None else sources.digest


def provide(sources: Sources | SessionFunction) -> None:
    """Let this process load an experiment from what another one has sent."""
    if isinstance(sources, SessionFunction):
        provide_function(sources)
    else:
        _provided[sources.path, sources.digest] = sources


def forget(reference: str) -> None:
    """Let an experiment's file and local modules be read again when it is loaded next; do nothing for an experiment in
    a module.
    """
    place, _, _ = reference.rpartition(":")
    if place.endswith(".py"):
        forget_module(place)


def _read(path: Path) -> Sources:
    try:
        return read_sources(path)
    except FileNotFoundError:
        raise SweepError(f"there is no file {shown(str(path))}") from None
    except OSError as error:
        raise SweepError(f"{path} cannot be read: {error.strerror or error}") from error


def _module_of_file(place: str, folder: Path | None, digest: str | None) -> ModuleType:
    path = ((folder or Path.cwd()) / place).resolve()
    key = str(path)
    loaded = sys.modules.get(key)
    if loaded is not None and digest in (None, loaded.__dict__[SOURCES].digest):
        return loaded
    sources = _provided.get((key, digest)) if digest is not None else None
    if sources is not None:
        key = f"{key}@{digest}"
        if key in sys.modules:
            return sys.modules[key]
    else:
        if loaded is not None:  # an earlier version; the file may have the wanted one by now
            forget_module(key)
        sources = _read(path)
    module = make_module(sources, key)
    setattr(module, SOURCES, sources)
    return module
