"""A distributed parameter-sweep platform for experiments that add up realisations.

``sweep.run`` runs a study, ``sweep.open`` reads its results; both give an `xarray.Dataset`.  ``fit_power_law``,
``fit_levelling``, ``find`` and ``ratio`` derive others from it, ``plot`` draws it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sweep.analysis.crossings import find
    from sweep.analysis.laws import fit_levelling, fit_power_law, ratio
    from sweep.api import open, run  # noqa: A004
    from sweep.plots.figure import draw_figure as plot

__all__ = ["find", "fit_levelling", "fit_power_law", "open", "plot", "ratio", "run"]

_HOMES = {
    **dict.fromkeys(("open", "run"), "sweep.api"),
    **dict.fromkeys(("fit_levelling", "fit_power_law", "ratio"), "sweep.analysis.laws"),
    "find": "sweep.analysis.crossings",
    "plot": "sweep.plots.figure",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for only then: each needs much that most commands do not."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), "draw_figure" if name == "plot" else name)
