"""The kinds of figures: the one table behind the choices of the command, the messages and the report.

To add a kind, add a line here and the module that it names.  No module is imported before its kind is drawn.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, NamedTuple


class Kind(NamedTuple):
    """What draws a figure, as ``module:name``, and a caption if the name of the kind does not say what it shows."""

    reference: str
    caption: str = ""

    def load(self) -> Any:
        """Return the object that draws the figure."""
        module, _, name = self.reference.partition(":")
        return getattr(import_module(module), name)


GRID: Mapping[str, Kind] = {
    "lines": Kind("linksweep.sweep.plots.grid_figures:LINES"),
    "law": Kind("linksweep.sweep.plots.grid_figures:LAW"),
    "map": Kind("linksweep.sweep.plots.grid_figures:MAP"),
    "scatter": Kind("linksweep.sweep.plots.grid_figures:SCATTER"),
    "points": Kind("linksweep.sweep.plots.grid_figures:POINTS"),
    "pairs": Kind("linksweep.sweep.plots.grid_figures:PAIRS"),
    "curves": Kind("linksweep.sweep.plots.grid_figures:CURVES"),
}
"""Kinds for the results of a study: objects of type `GridFigure`."""

SCALING: Mapping[str, Kind] = {"scaling": Kind("linksweep.sweep.plots.standalone:scaling_figure")}
"""Kinds for the measurements of `sweep scaling`: functions of its dataset."""

STANDALONE: Mapping[str, Kind] = {
    "sky": Kind("linksweep.sweep.plots.standalone:sky_figure"),
    "accuracy": Kind("linksweep.sweep.plots.standalone:accuracy_figure"),
}
"""Kinds for catalogues and missions: functions of a dataset of `sweep.plots.views`."""

LINK: Mapping[str, Mapping[str, Kind]] = {
    "tie": {
        "solution": Kind(
            "linksweep.sweep.plots.tie.solution:solution_figure", "The unknowns with errors of several kinds"
        ),
        "residuals": Kind(
            "linksweep.sweep.plots.tie.residuals:residual_figure",
            "Differences before and residuals after the fit on the sky",
        ),
        "separations": Kind(
            "linksweep.sweep.plots.tie.sources:separation_figure",
            "Normalised separations of the sources, beside the Rayleigh distribution expected if errors are right",
        ),
        "weight": Kind(
            "linksweep.sweep.plots.tie.sources:weight_figure",
            "Discrepancy of each source per observation, against its share of the weight",
        ),
        "ranking": Kind("linksweep.sweep.plots.tie.sources:influence_figure", "The most influential sources"),
        "jackknife": Kind(
            "linksweep.sweep.plots.tie.left_out:jackknife_figure",
            "Solutions without each source, and ellipses of the errors",
        ),
        "trajectory": Kind(
            "linksweep.sweep.plots.tie.left_out:trajectory_figure", "The solution while the clip drops sources"
        ),
        "spectrum": Kind(
            "linksweep.sweep.plots.tie.spectrum:spectrum_figure",
            "Vector spherical harmonics by degree, beside noise, and their significance",
        ),
        "bins": Kind("linksweep.sweep.plots.tie.solution:bin_figure", "The spin in each bin"),
    },
    "forecast": {
        "epochs": Kind(
            "linksweep.sweep.plots.tie.forecasts:epoch_figure", "Formal errors against the epoch of new positions"
        ),
        "ranking": Kind(
            "linksweep.sweep.plots.tie.forecasts:ranking_figure", "The sources whose observation helps most"
        ),
    },
}
"""Kinds for the results of `sweep tie` and `sweep forecast`: functions of these; the first possible is the default."""


def all_kinds() -> list[str]:
    """Return the names of all kinds."""
    return list(dict.fromkeys(kind for kinds in (GRID, SCALING, STANDALONE, *LINK.values()) for kind in kinds))
