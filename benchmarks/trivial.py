"""The cheapest experiment there is: six floats a point, by arithmetic."""

from pathlib import Path
from typing import Any

from linksweep.sweep.contract import Experiment, Output, Parameter

NAMES = ("a", "b", "c", "d", "e", "f")


def evaluate(points: Any, n_sim: int, rng: Any, catalogue_rng: Any) -> dict[str, list[float]]:
    """Return six numbers of each point."""
    return {name: [(k + 1.0) * p["x"] + p["y"] for p in points] for k, name in enumerate(NAMES)}


experiment = Experiment(
    name="trivial",
    version=1,
    parameters=(Parameter("x", "float", 0.0, "the first axis"), Parameter("y", "float", 0.0, "the second axis")),
    sums=dict.fromkeys(NAMES, ()),
    outputs=tuple(Output(f"mean_{name}", "", f"mean of {name}") for name in NAMES),
    evaluate=evaluate,
    summarise=lambda sums, n, n_cat: {f"mean_{name}": sums[name] / n for name in NAMES},
)


FUNCTION = f"{Path(__file__).resolve()}:six"
"""The same as a plain function."""


def six(x: float = 0.0, y: float = 0.0) -> dict[str, float]:
    """Return six numbers of a point."""
    return {f"mean_{name}": (k + 1.0) * x + y for k, name in enumerate(NAMES)}


def study(points: int) -> dict[str, Any]:
    """Return the document of a study of about so many points of it, in a square."""
    side = round(points**0.5)
    axis = {"start": 0.0, "stop": side - 1.0, "num": side}
    return {
        "title": f"{side} x {side} points that cost nothing",
        "experiment": f"{Path(__file__).resolve()}:experiment",
        "axes": {"x": axis, "y": axis},
        "sampling": {"n_sim": 1, "n_cat": 1, "seed": 1},
    }


def toml(points: int) -> str:
    """Return the same as a study file."""
    document = study(points)
    axes = "".join(
        f"{n} = {{ start = 0.0, stop = {a['stop']}, num = {a['num']} }}\n" for n, a in document["axes"].items()
    )
    return (
        f'title = "{document["title"]}"\nexperiment = "{document["experiment"]}"\n'
        f"[axes]\n{axes}[sampling]\nn_sim = 1\nn_cat = 1\nseed = 1\n"
    )
