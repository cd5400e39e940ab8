"""Finds an experiment by its reference, ``module:attribute`` or ``path/to/file.py:attribute``."""

import hashlib
import importlib
import importlib.machinery
import importlib.util
import sys
from pathlib import Path
from typing import Any

from sweep.contract import Experiment, SweepError, shown

DIGEST = "__linksweep_source_digest__"


def load_experiment(reference: str, folder: Path | None = None) -> Experiment:
    """Return the Experiment that a reference names; a file's path is relative to ``folder``.

    Raises SweepError where the module, the file or the attribute does not exist or is something else.
    """
    place, colon, attribute = reference.rpartition(":")
    if not colon or not place or not attribute:
        raise SweepError(f"{shown(reference)}: write module:attribute or file.py:attribute")
    try:
        module = _module_of_file(place, folder) if place.endswith(".py") else importlib.import_module(place)
        found = getattr(module, attribute, None)
    except SweepError:
        raise
    except (Exception, SystemExit) as error:  # whatever a user's module raises while it is imported
        raise SweepError(f"{shown(reference)}: cannot be imported: {type(error).__name__}: {error}") from error
    if not isinstance(found, Experiment):
        kind = "has no attribute" if found is None else f"has a {type(found).__name__}, not an Experiment, at"
        raise SweepError(f"{shown(reference)}: the module {kind} {shown(attribute)}")
    return found


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


def _module_of_file(place: str, folder: Path | None) -> object:
    path = (folder or Path.cwd()) / place
    name = str(path.resolve())
    if name in sys.modules:
        return sys.modules[name]
    if not path.is_file():
        raise SweepError(f"there is no file {path}")
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
