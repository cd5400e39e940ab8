"""The code that determines the results of an experiment: sources, defaults, versions of packages."""

import json
import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import packages_distributions
from pathlib import Path

from sweep.contract import Experiment
from sweep.distributions import version_of
from sweep.load import sources_of
from sweep.session import SessionFunction
from sweep.sources import INSTALLED, OURS, Sources, read_sources


def code_of(reference: str, experiment: Experiment, digest: str | None = None) -> dict[str, str]:
    """Return what determines the results of a loaded experiment besides its version: source files, defaults, versions
    of packages.

    For an experiment in an installed distribution this is the version of the distribution; experiments that come with
    linksweep are identified by their own version alone.
    """
    code: dict[str, str] = {}
    place = reference.rpartition(":")[0]
    sources: Sources | SessionFunction | None = sources_of(reference, digest)
    if sources is None and place.partition(".")[0] not in OURS:
        sources = _sources_of_module(place)
        if sources is None:
            code |= {f"package {name}": version_of(name) for name in _distributions_of(place.partition(".")[0])}
    if sources is not None:
        code |= sources.parts
        defaults = {p.name: json.dumps(p.written_default(), default=str) for p in experiment.parameters}
        code |= {f"default of {name}": text for name, text in defaults.items()}
    return code | {f"package {name}": version_of(name) for name in experiment.packages}


def code_differences(old: Mapping[str, str], new: Mapping[str, str], was: str, now: str) -> list[str]:
    """Return a phrase for each difference between two versions of code; ``was`` and ``now`` say where they are."""
    phrases = []
    for name in sorted({*old, *new}):
        before, after = old.get(name), new.get(name)
        if before == after:
            continue
        if before is None or after is None:
            phrases.append(f"{name} is only {was if after is None else now}")
        elif name.startswith(("file ", "function ", "value ")):
            phrases.append(f"{name} has changed")
        else:
            phrases.append(f"{name} is {before} {was}, {after} {now}")
    return phrases


@lru_cache(maxsize=16)
def _distributions_of(package: str) -> list[str]:
    return sorted(set(packages_distributions().get(package, [])))


@lru_cache(maxsize=16)  # as they were when the module was loaded: Python does not load it again
def _sources_of_module(name: str) -> Sources | None:
    """Return the sources of a module and of what it imports from the folder of its top package; None if the module is
    in an installed distribution, or is not written in Python.
    """
    path = getattr(sys.modules.get(name), "__file__", None)
    if path is None or not path.endswith(".py") or INSTALLED & set(Path(path).parts):
        return None
    file = Path(path).resolve()
    above = name.count(".") + (file.name == "__init__.py")
    return read_sources(file, file.parents[above])
