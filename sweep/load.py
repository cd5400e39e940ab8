"""Finds experiments and functions by their references, ``module:attribute`` or ``path/to/file.py:attribute``."""

import hashlib
import importlib
import importlib.machinery
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sweep.contract import Experiment, SweepError, shown

DIGEST = "__linksweep_source_digest__"


def load_experiment(reference: str, folder: Path | None = None) -> Experiment:
    """Return the Experiment that a reference names; a file's path is relative to ``folder``.

    Raises SweepError where the module, the file or the attribute does not exist or is something else.
    """
    _, found = _find(reference, folder)
    if not isinstance(found, Experiment):
        raise _is_no("an Experiment", reference, found)
    return found


@dataclass(frozen=True)
class SourceFunction:
    """A function of a user's: found by its reference in whichever process calls it, and known by the digest of the file
    that it stands in.

    Calling it raises SweepError where that file is gone or another one than when it was loaded.
    """

    reference: str = field(compare=False)
    name: str
    digest: str

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return _function(self)(*arguments)


def load_function(reference: str, folder: Path | None = None) -> SourceFunction:
    """Return the function that a reference names, as it stands in its file now; a file's path is relative to
    ``folder``.

    Raises SweepError as `load_experiment`, and for what cannot be called or has no file in Python.
    """
    absolute = absolute_reference(reference, folder or Path.cwd())
    module, found = _find(absolute)
    if _digest(module) != getattr(module, DIGEST, _digest(module)):  # a file that has changed since it was read
        forget(absolute)
        module, found = _find(absolute)
    digest = _digest(module)
    if not callable(found):
        raise _is_no("a function", reference, found)
    if digest is None:
        raise SweepError(f"{shown(reference)}: has no source file, by which its numbers could be known")
    return SourceFunction(absolute, absolute.rpartition(":")[2], digest)


@lru_cache(maxsize=16)
def _function(wanted: SourceFunction) -> Callable[..., Any]:
    found = load_function(wanted.reference)
    if found.digest != wanted.digest:
        raise SweepError(f"{wanted.reference}: its file is not the one that the study was read with")
    _, function = _find(wanted.reference)
    assert callable(function), "asked for when it was loaded"
    return function


def _digest(module: ModuleType) -> str | None:
    """Return the digest of a module's file as it is now; None where it has none in Python."""
    path = getattr(module, "__file__", None)
    if path is None or not str(path).endswith(".py") or not Path(path).is_file():
        return None
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]


def _find(reference: str, folder: Path | None = None) -> tuple[ModuleType, object]:
    """Return the module of a reference and what it names there, None for nothing."""
    place, colon, attribute = reference.rpartition(":")
    if not colon or not place or not attribute:
        raise SweepError(f"{shown(reference)}: write module:attribute or file.py:attribute")
    try:
        module = _module_of_file(place, folder) if place.endswith(".py") else importlib.import_module(place)
        return module, getattr(module, attribute, None)
    except SweepError:
        raise
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        raise SweepError(f"{shown(reference)}: cannot be imported: {type(error).__name__}: {error}") from error


def _is_no(wanted: str, reference: str, found: object) -> SweepError:
    attribute = reference.rpartition(":")[2]
    kind = "has no attribute" if found is None else f"has a {type(found).__name__}, not {wanted}, at"
    return SweepError(f"{shown(reference)}: the module {kind} {shown(attribute)}")


def absolute_reference(reference: str, folder: Path) -> str:
    """Return the reference as it works from any directory: a file's path is made absolute."""
    place, _, attribute = reference.rpartition(":")
    return f"{(folder / place).resolve()}:{attribute}" if place.endswith(".py") else reference


def source_digest(reference: str) -> str | None:
    """Return the digest of the file that a loaded experiment came from, as it was then; None for one of a module."""
    place, _, _ = reference.rpartition(":")
    return getattr(sys.modules.get(place), DIGEST, None) if place.endswith(".py") else None


def forget(reference: str) -> None:
    """Let an experiment's file be read anew when it is loaded again; does nothing for one of a module."""
    place, _, _ = reference.rpartition(":")
    if place.endswith(".py"):
        sys.modules.pop(place, None)


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module without leaving a ``__pycache__`` beside it."""

    def set_data(self, path: str, data: Any, *, _mode: int = 0o666) -> None:
        """Write nothing."""


def _module_of_file(place: str, folder: Path | None) -> ModuleType:
    path = (folder or Path.cwd()) / place
    name = str(path.resolve())
    if name in sys.modules:
        return sys.modules[name]
    if not path.is_file():
        raise SweepError(f"there is no file {shown(str(path))}")
    spec = importlib.util.spec_from_file_location(name, path, loader=_Loader(name, str(path)))
    if spec is None or spec.loader is None:
        raise SweepError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    setattr(module, DIGEST, hashlib.sha256(path.read_bytes()).hexdigest()[:12])
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
