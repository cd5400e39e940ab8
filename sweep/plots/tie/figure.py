"""Which pictures the dataset of a link or a forecast can have, and which suits it."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from sweep.contract import SweepError, shown, suggest
from sweep.plots.tie.bins import bin_figure
from sweep.plots.tie.forecasts import epoch_figure, ranking_figure
from sweep.plots.tie.jackknife import jackknife_figure
from sweep.plots.tie.residuals import residual_figure
from sweep.plots.tie.separations import separation_figure
from sweep.plots.tie.solution import solution_figure
from sweep.plots.tie.spectrum import spectrum_figure
from sweep.plots.tie.trajectory import trajectory_figure
from sweep.plots.tie.weights import influence_figure, weight_figure

Draw = Callable[[xr.Dataset], Figure]

FIGURES: Mapping[str, Mapping[str, Draw]] = {
    "tie": {
        "solution": solution_figure,
        "residuals": residual_figure,
        "separations": separation_figure,
        "weight": weight_figure,
        "ranking": influence_figure,
        "jackknife": jackknife_figure,
        "trajectory": trajectory_figure,
        "spectrum": spectrum_figure,
        "bins": bin_figure,
    },
    "forecast": {"epochs": epoch_figure, "ranking": ranking_figure},
}
"""Kinds of pictures of each kind of result; the first that a dataset can have suits it."""

CAPTIONS: Mapping[str, str] = {
    "solution": "The unknowns with errors of several kinds",
    "residuals": "Differences before and residuals after the fit on the sky",
    "separations": "Normalised separations of the sources, beside the Rayleigh distribution of right errors",
    "weight": "Discrepancy of each source, for one observation, against its share of the weight",
    "ranking": "The sources that decide most",
    "jackknife": "Solutions without each source, and ellipses of the errors",
    "trajectory": "The solution while the clip drops sources",
    "spectrum": "Vector spherical harmonics by degree, beside noise, and their significance",
    "bins": "The spin in each bin",
    "epochs": "Formal errors against the epoch of new positions",
}


def is_link(dataset: xr.Dataset) -> bool:
    """Return whether a dataset is that of `sweep tie` or `sweep forecast`."""
    return dataset.attrs.get("result") in FIGURES


def draw_link(dataset: xr.Dataset, kind: str | None = None) -> Figure:
    """Return a figure of a link or a forecast; raises SweepError for a kind that it cannot have."""
    kinds = FIGURES[dataset.attrs["result"]]
    if kind is not None:
        if kind not in kinds:
            raise SweepError(f"no kind {shown(kind)} of a {dataset.attrs['result']}{suggest(kind, list(kinds))}")
        return _titled(kinds[kind](dataset), dataset)
    for figure in link_figures(dataset).values():
        return figure
    raise SweepError(f"nothing to draw of this {dataset.attrs['result']}")


def link_figures(dataset: xr.Dataset, kinds: Sequence[str] = (), titled: bool = True) -> dict[str, Figure]:
    """Return all figures that a link or a forecast can have, or those of ``kinds`` that it can, by kind."""
    found = {}
    for kind, draw in FIGURES[dataset.attrs["result"]].items():
        if kinds and kind not in kinds:
            continue
        try:
            figure = draw(dataset)
        except SweepError:  # says what the dataset lacks
            continue
        found[kind] = _titled(figure, dataset) if titled else figure
    return found


def _titled(figure: Figure, dataset: xr.Dataset) -> Figure:
    attributes = dataset.attrs
    words = f"{Path(attributes['satellite']).name} and {Path(attributes['reference']).name}"
    if "sign" in attributes:
        words += (
            f"\n{attributes['sign'].replace('-', ' − ')}, epoch {attributes['epoch']:.2f}, clip {attributes['clip']}"
        )
    figure.suptitle(words, fontsize="medium")
    return figure
