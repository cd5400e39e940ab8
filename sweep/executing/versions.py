"""What a process computes with: versions and code, which are compared before a run and with every task."""

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from threadpoolctl import threadpool_info

from linksweep.sweep.code.load import code_of, load_experiment, source_digest
from linksweep.sweep.code.reach import version_of

DECIDING = ("linksweep", "numpy", "scipy")
OTHERS = ("dask", "distributed", "msgpack", "cloudpickle", "tornado", "threadpoolctl")


@dataclass(frozen=True)
class Identity:
    """What a process computes with, by name: versions and code that decide the numbers, and other versions."""

    deciding: Mapping[str, str]
    others: Mapping[str, str]


def identity(reference: str, digest: str | None = None) -> Identity:
    """Return with what this process would compute an experiment; raises SweepError as `load_experiment`."""
    experiment = load_experiment(reference, digest=digest or source_digest(reference))
    code = code_of(reference, experiment, digest).items()
    deciding = {name: version_of(name) for name in DECIDING}
    deciding[f"experiment {experiment.name!r}"] = f"version {experiment.version}"
    deciding |= {name: text for name, text in code if not name.startswith("value ")}  # such as a time
    others = {"python": platform.python_version(), "machine": platform.machine(), "linear algebra": _kernels()}
    return Identity(deciding, others | {name: version_of(name) for name in OTHERS})


@cache
def _kernels() -> str:
    """Return for which processor each library of linear algebra computes, on which the rounding of sums depends."""
    known = (info for info in threadpool_info() if "architecture" in info)
    return ", ".join(sorted({f"{info['internal_api']} for {info['architecture']}" for info in known})) or "unknown"


def other_versions(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """Return a phrase for everything that differs between two processes."""
    pairs = {name: (here.get(name, "unknown"), there.get(name, "unknown")) for name in {**here, **there}}
    return [f"{name} is {one} here, {other} there" for name, (one, other) in pairs.items() if one != other]
