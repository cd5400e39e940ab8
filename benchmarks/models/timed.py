"""Times one model swept by one tool, in an environment that has it: ``python timed.py linksweep sir POINTS [once]``.

Sweeps a few points first, so that imports do not count, then those of the axes (at most POINTS of each), checks the
numbers against the model itself, and prints seconds of both, points and lines of code as JSON.  With ``once`` it does
nothing but sweep the axes, so that the whole process can be timed.
"""

import importlib
import inspect
import itertools
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import models
import numpy as np

OUTPUT = {"sir": "peak", "wait": "wait_mean", "vectorised": "area", "trivial": "area"}
FIRST = 4
"""Values of each axis in the first sweeps: a round of the four workers that `nap` is swept on."""

OUTSIDE = 5.0
"""Errors that a mean may be off."""


def lines_of(function):
    """Return how many lines of code a sweep takes: without its first, its docstring and the empty ones, with those of
    the functions that it needs for itself.
    """
    source = inspect.getsource(function)
    lines = [line.strip() for line in source.splitlines()[1:]]
    ours = sum(bool(line) and not line.startswith('"""') for line in lines)
    helper = getattr(inspect.getmodule(function), "_seeded", None)
    return ours + (len(inspect.getsource(helper).splitlines()) if helper is not None and "_seeded" in source else 0)


def check(name, axes, actual):
    """Compare some points with what the model itself returns."""
    model = getattr(models, "area" if name in ("vectorised", "trivial") else name)
    for values in itertools.islice(itertools.product(*axes.values()), 0, None, 97):
        point = dict(zip(axes, values, strict=True))
        result = float(actual[OUTPUT.get(name, name)].sel(point))
        if name == "wait":
            rng = np.random.default_rng(7)
            drawn = [model(**point, rng=rng) for _ in range(models.REALISATIONS)]
            allowed = OUTSIDE * np.std(drawn) * (2.0 / len(drawn)) ** 0.5
            assert abs(result - np.mean(drawn)) < allowed, (point, result, np.mean(drawn))
            continue
        expected = model(**point)
        assert result == (expected[1] if name == "sir" else expected), (point, result, expected)
        if name == "sir":
            curve = actual["infected"].sel(point)
            assert np.array_equal(curve.values if curve.ndim else curve.item(), expected[0]), point


def main(tool, name, most, once=""):
    """Time one model by one tool in a folder of its own."""
    sweep = getattr(importlib.import_module(f"with_{tool}"), name)
    axes = {axis: values[: int(most)] for axis, values in models.AXES[name].items()}
    if once:
        sweep(axes)
        return
    few = {axis: values[:FIRST] for axis, values in axes.items()}
    seconds = {}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for kind, chosen in (("import", few), ("few", few), ("all", axes)):
            place = Path(folder) / kind
            place.mkdir()
            os.chdir(place)
            begun = time.perf_counter()
            actual = sweep(chosen)
            seconds[kind] = time.perf_counter() - begun
        check(name, axes, actual)
        os.chdir(os.sep)
    report = {"first_seconds": seconds["few"], "seconds": seconds["all"], "lines": lines_of(sweep)}
    print(json.dumps(report), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
