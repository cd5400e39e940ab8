"""Plain functions beside xyzpy and pipefunc: the same models, with the numbers checked, in lines of code, in seconds
after the imports, and as whole processes.

Ours run with the packages of this environment, `sun` only where pvlib is one of them.
"""

import json
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from benchmarks.measured import Measured, Size, Target, watch
from benchmarks.peer_environment import environment

TIMED = Path(__file__).parent / "models" / "timed.py"
MODELS = {
    "sir": "an ODE with a series",
    "wait": "a queue with a quantile",
    "sun": "pvlib",
    "vectorised": "20 000 points, vectorised",
    "trivial": "10 000 trivial points",
    "nap": "40 x 0.5 s on 4 workers",
}
TOOLS = ("linksweep", "xyzpy", "pipefunc")
MOST = {"tiny": 4, "normal": 1000, "full": 1000}
IDEAL_S = (40 - 4) * 0.5 / 4
"""What the naps of `nap` beyond the first four take on four workers."""

VECTORISED, NEAR_IDEAL = Target("<=", 2.0), Target("<=", 1.1)

WHOLE = {"nap": ("xyzpy", "pipefunc"), "vectorised": ("xyzpy",), "trivial": ("xyzpy",)}
"""The peers that whole commands are compared with: the faster pool of forked processes, and what keeps nothing before
the end.
"""

WHOLE_TARGETS = {"nap": NEAR_IDEAL, "vectorised": Target("<=", 3.0), "trivial": Target("<=", 3.0)}

FOUR = ("sir", "wait", "sun", "vectorised")


class Timed(NamedTuple):
    """What `benchmarks/models/timed.py` tells: seconds of a whole sweep and of its first points alone."""

    first_seconds: float
    seconds: float
    lines: int


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return lines of code and seconds of each model by each tool, taking turns."""
    pythons = {"linksweep": sys.executable}
    if peers:
        pythons |= dict.fromkeys(TOOLS[1:], str(environment()))
    report: list[Measured] = []
    lines = {tool: [0.0] for tool in pythons}
    for model, words in MODELS.items():
        result: dict[str, list[Timed]] = {tool: [] for tool in pythons}
        notes = dict.fromkeys(pythons, "")
        for _ in range(1 if size == "tiny" else repetitions):
            for tool, python in pythons.items():
                if (model, tool) == ("sun", "linksweep") and find_spec("pvlib") is None:
                    notes[tool] = "pvlib is not installed here"
                    continue
                try:
                    result[tool].append(_timed(python, tool, model, MOST[size]))
                except (RuntimeError, ValueError, IndexError) as error:
                    notes[tool] = str(error).strip().splitlines()[-1]
        for tool, reported in result.items():
            note = notes[tool] or f"{reported[0].lines} lines"
            target = VECTORISED if (model, tool) == ("vectorised", "linksweep") else None
            report.append(Measured(f"{words}: {tool}", [one.seconds for one in reported], "s", target, note))
            if model == "nap":
                after = [(one.seconds - one.first_seconds) / IDEAL_S for one in reported]
                target = NEAR_IDEAL if tool == "linksweep" and size != "tiny" else None
                report.append(Measured(f"{words}, over the ideal after start: {tool}", after, "", target))
            if model in FOUR and reported:
                lines[tool][0] += reported[0].lines
    report += _whole_commands(pythons, size, repetitions) if peers else []
    return [*report, *(Measured(f"lines of code of the first four: {tool}", n) for tool, n in lines.items())]


def _whole_commands(pythons: dict[str, str], size: Size, repetitions: int) -> list[Measured]:
    """Return seconds of whole processes that sweep a model once, by turns, and ours over those of its fastest peer."""
    report: list[Measured] = []
    for model, others in WHOLE.items():
        seconds: dict[str, list[float]] = {tool: [] for tool in ("linksweep", *others)}
        for _ in range(1 if size == "tiny" else repetitions):
            for tool, taken in seconds.items():
                command = [pythons[tool], str(TIMED), tool, model, str(MOST[size]), "once"]
                with tempfile.TemporaryDirectory() as folder:
                    taken.append(watch(command, Path(folder)).seconds)
        words = f"{MODELS[model]}, whole command"
        report += [Measured(f"{words}: {tool}", taken, "s") for tool, taken in seconds.items()]
        ratios = [ours / min(rest) for ours, *rest in zip(*seconds.values(), strict=True)]
        target = WHOLE_TARGETS[model] if size != "tiny" else None
        report.append(Measured(f"{words}, over {' or '.join(others)}", ratios, "", target))
    return report


def _timed(python: str, tool: str, model: str, most: int) -> Timed:
    with tempfile.TemporaryDirectory() as folder:
        output = watch([python, str(TIMED), tool, model, str(most)], Path(folder)).output
    return Timed(**json.loads(output.splitlines()[-1]))
