"""What decides the numbers that a process computes: client and workers must agree on it."""

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from threadpoolctl import threadpool_info

from linksweep.sweep.code.load import code_of, load_experiment, source_digest
from linksweep.sweep.code.reach import version_of
from linksweep.sweep.contract import SweepError

DECIDING = ("linksweep", "numpy", "scipy")
OTHERS = ("dask", "distributed", "msgpack", "cloudpickle", "tornado", "threadpoolctl")


@dataclass(frozen=True)
class Identity:
    """Versions by name: those of what decides the numbers, and others."""

    deciding: Mapping[str, str]
    others: Mapping[str, str]


def identity(reference: str, digest: str | None = None) -> Identity:
    """Return the versions by which this process would compute an experiment; raises SweepError as `load_experiment`."""
    digest = digest or source_digest(reference)
    return _versions(reference, None) if digest is None else _identity(reference, digest)  # a module may be reloaded


@lru_cache(maxsize=64)  # workers compare it with every task
def _identity(reference: str, digest: str) -> Identity:
    return _versions(reference, digest)


def _versions(reference: str, digest: str | None) -> Identity:
    experiment = load_experiment(reference, digest=digest)
    deciding = {name: version_of(name) for name in DECIDING}
    deciding[f"experiment {experiment.name!r}"] = f"version {experiment.version}"
    for name, text in code_of(reference, experiment, digest).items():
        if not name.startswith("value "):  # such as a time or the number of a process
            deciding[name] = text if name.startswith(("package ", "default ")) else f"with digest {text}"
    others = {"python": platform.python_version(), "machine": platform.machine(), "linear algebra": _kernels()}
    return Identity(deciding, others | {name: version_of(name) for name in OTHERS})


@cache
def _kernels() -> str:
    """Return for which processor each library of linear algebra computes, on which the rounding of sums depends."""
    kernels = {
        f"{info['internal_api']} for {info['architecture']}" for info in threadpool_info() if "architecture" in info
    }
    return ", ".join(sorted(kernels)) or "unknown"


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """Return a phrase for everything that differs."""
    pairs = {name: (here.get(name, "unknown"), there.get(name, "unknown")) for name in {**here, **there}}
    return [f"{name} is {one} here, {other} there" for name, (one, other) in pairs.items() if one != other]


def require_same(expected: Mapping[str, str], answers: Mapping[str, Any]) -> None:
    """Raise SweepError with a list of the workers, by their addresses, that have answered with an exception or with an
    `Identity` in which something that decides the numbers is not as ``expected``.

    A worker that has gone meanwhile (OSError) is left out: should it return, it is compared with its first task.
    """
    problems = []
    for worker, what in sorted(answers.items()):
        if isinstance(what, OSError):
            continue
        if isinstance(what, BaseException):
            problems.append(f"{worker}: {type(what).__name__}: {what}")
        else:
            problems += [f"{worker}: {text}" for text in differences(expected, what.deciding)]
    if problems:
        raise SweepError(problems, "workers that would not compute what this process would")
