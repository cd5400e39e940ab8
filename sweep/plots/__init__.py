"""Figures of results.  The choices of `sweep plot --kind`, messages and reports follow the table of kinds here.

No module that draws is imported before a figure is made, because matplotlib takes longer than most commands.
"""

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, NamedTuple


class Kind(NamedTuple):
    """What draws a figure, as ``module:name``, and a caption if the name of the kind does not say what it shows."""

    reference: str
    caption: str = ""

    def load(self) -> Any:
        """Return the object that draws the figure."""
        return resolve_name(f"linksweep.sweep.plots.{self.reference}")


# Kinds of figures by the kind of result that they are drawn of; the first is the default, of a grid what suits it.  A
# function draws a dataset, for a grid some quantities along axes (``over``), and raises SweepError where something is
# missing; `style.complete` adds title and legend.
KINDS: Mapping[str, Mapping[str, Kind]] = {
    "grid": {
        "lines": Kind("figure:lines_figure"),
        "law": Kind("figure:law_figure"),
        "map": Kind("figure:map_figure"),
        "scatter": Kind("figure:scatter_figure"),
        "points": Kind("figure:points_figure"),
        "pairs": Kind("figure:pairs_figure"),
        "curves": Kind("figure:curves_figure"),
    },
    "scaling": {"scaling": Kind("figure:scaling_figure")},
    "sensitivity": {"sensitivity": Kind("figure:sensitivity_figure")},
    "catalogue": {"sky": Kind("link:sky_figure"), "accuracy": Kind("link:accuracy_figure")},
    "tie": {
        "solution": Kind("link:solution_figure", "The unknowns with errors of several kinds"),
        "residuals": Kind("link:residual_figure", "Differences before and residuals after the fit on the sky"),
        "separations": Kind("link:separation_figure", "Shares of sources beyond each normalised separation"),
        "weight": Kind("link:weight_figure", "Discrepancy per observation against the share of the weight"),
        "ranking": Kind("link:influence_figure", "The most influential sources"),
        "jackknife": Kind("link:jackknife_figure", "Solutions without each source, and ellipses of the errors"),
        "trajectory": Kind("link:trajectory_figure", "The solution while the clip drops sources"),
        "spectrum": Kind("link:spectrum_figure", "Vector spherical harmonics by degree, noise and significance"),
        "bins": Kind("link:bin_figure", "The spin in each bin"),
    },
    "match": {"galaxies": Kind("link:galaxy_figure", "The galaxies among the stars")},
    "forecast": {
        "epochs": Kind("link:epoch_figure", "Formal errors against the epoch of new positions"),
        "ranking": Kind("link:ranking_figure", "The sources whose observation helps most"),
    },
}

ALL_KINDS = list(dict.fromkeys(kind for kinds in KINDS.values() for kind in kinds))
