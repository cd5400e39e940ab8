"""Reads the file that describes a Dask cluster: its class, the class's options, and how large it is to be."""

import importlib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError, shown, suggest

KEYS = ("class", "options", "scale", "adapt")
BOUNDS = ("minimum", "maximum", "minimum_jobs", "maximum_jobs")
ADAPT_KEYS = (*BOUNDS, "interval", "wait_count", "target_duration")


@dataclass(frozen=True)
class ClusterFile:
    """What a file says of a cluster: the arguments of its class and of its `scale` or `adapt`, and the file itself."""

    path: Path
    class_name: str
    options: Mapping[str, Any]
    scale: Mapping[str, Any] | None
    adapt: Mapping[str, Any] | None


def read_cluster_file(path: Path) -> ClusterFile:
    """Return what a TOML or YAML file says about a cluster; raises SweepError with everything that is wrong in it."""
    document = _parse(path)
    problems = [f"unknown key {shown(key)}{suggest(str(key), KEYS)}" for key in document if key not in KEYS]
    name = document.get("class")
    if not isinstance(name, str) or not all(part.isidentifier() for part in name.split(".")) or "." not in name:
        problems.append(
            f"class = {shown(name)}: must be the import path of a cluster's class, e.g. 'dask_jobqueue.SLURMCluster'"
        )
    options = document.get("options", {})
    if not isinstance(options, dict) or not all(isinstance(key, str) for key in options):
        problems.append(f"options = {shown(options)}: must be a table of the keyword arguments of the class")
    scale: Any = document.get("scale")
    adapt: Any = document.get("adapt")
    if (scale is None) == (adapt is None):
        problems.append("write either scale = WORKERS or adapt = { minimum = WORKERS, maximum = WORKERS }")
    if isinstance(scale, int) and not isinstance(scale, bool):
        scale = {"n": scale}
    if scale is not None and (
        not isinstance(scale, dict) or not scale or not all(_is_count(v, 1) for v in scale.values())
    ):
        problems.append(f"scale = {shown(document['scale'])}: must be a number of workers, or {{ jobs = NUMBER }}")
    if adapt is not None:
        problems += _problems_of_adapt(adapt)
    if problems:
        raise SweepError(problems, str(path))
    return ClusterFile(path, str(name), options, scale, adapt)


def _problems_of_adapt(adapt: object) -> list[str]:
    if not isinstance(adapt, dict) or not adapt:
        return [f"adapt = {shown(adapt)}: must be a table, {{ minimum = WORKERS, maximum = WORKERS }}"]
    problems = [f"unknown key adapt.{key}{suggest(str(key), ADAPT_KEYS)}" for key in adapt if key not in ADAPT_KEYS]
    bounds = {key: value for key, value in adapt.items() if key in BOUNDS}
    for key, value in bounds.items():
        least = int(key.startswith("maximum"))
        if not _is_count(value, least):
            problems.append(f"adapt.{key} = {shown(value)}: must be a number of workers of at least {least}")
    if not any(key.startswith("maximum") for key in bounds):
        problems.append("adapt: must say a maximum; without one the cluster would grow with the work")
    if not problems:
        for low, high in (BOUNDS[:2], BOUNDS[2:]):
            if bounds.get(low, 0) > bounds.get(high, math.inf):
                problems.append(f"adapt.{low} = {bounds[low]}: must be at most adapt.{high} = {bounds[high]}")
    return problems


def cluster_class(file: ClusterFile) -> Any:
    """Return the class that a cluster file names; raises SweepError where there is none or it is no Dask cluster."""
    module, _, attribute = file.class_name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a module raises while it is imported
        missing = isinstance(error, ModuleNotFoundError) and error.name == "dask_jobqueue"
        hint = "; pip install 'linksweep[jobqueue]'" if missing else ""
        kind = "" if isinstance(error, ModuleNotFoundError | AttributeError) else f"{type(error).__name__}: "
        raise SweepError(f"class = {file.class_name!r}: {kind}{error}{hint}", str(file.path)) from error
    if not isinstance(found, type) or not all(hasattr(found, name) for name in ("scale", "adapt", "close")):
        raise SweepError(f"class = {file.class_name!r}: is no class of a Dask cluster", str(file.path))
    return found


def _is_count(value: object, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _parse(path: Path) -> Mapping[Any, Any]:
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        document = yaml.safe_load(text) if path.suffix in (".yaml", ".yml") else tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise SweepError(f"cannot be read: {error}", str(path)) from error
    except tomllib.TOMLDecodeError as error:
        raise SweepError(f"not valid TOML: {error}", str(path)) from error
    except yaml.YAMLError as error:
        raise SweepError(f"not valid YAML: {' '.join(str(error).split())}", str(path)) from error
    if not isinstance(document, dict):
        raise SweepError("must be a table with the keys class, options, and scale or adapt", str(path))
    return document
