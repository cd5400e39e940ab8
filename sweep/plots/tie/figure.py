"""Which pictures the dataset of a link or a forecast can have, and which suits it."""

from contextlib import suppress
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.plots.kinds import LINK


def is_link(dataset: xr.Dataset) -> bool:
    """Return whether a dataset is that of `sweep tie` or `sweep forecast`."""
    return dataset.attrs.get("result") in LINK


def draw_link(dataset: xr.Dataset, kind: str | None = None) -> Figure:
    """Return a figure of a link or a forecast; raises SweepError for a kind that it cannot have."""
    kinds = LINK[dataset.attrs["result"]]
    if kind is None:
        for figure in link_figures(dataset).values():
            return figure
        kind = next(iter(kinds))  # whose SweepError says what is missing
    if kind not in kinds:
        raise SweepError(f"no kind {shown(kind)} of a {dataset.attrs['result']}{suggest(kind, list(kinds))}")
    return _titled(_drawn(dataset, kind), dataset)


def link_figures(dataset: xr.Dataset, titled: bool = True) -> dict[str, Figure]:
    """Return all figures that a link or a forecast can have, by kind."""
    found = {}
    for name in LINK[dataset.attrs["result"]]:
        with suppress(SweepError):  # says what the dataset lacks
            figure = _drawn(dataset, name)
            found[name] = _titled(figure, dataset) if titled else figure
    return found


def _drawn(dataset: xr.Dataset, kind: str) -> Figure:
    figure: Figure = LINK[dataset.attrs["result"]][kind].load()(dataset)
    figure.set_label(kind)  # for the caption
    return figure


def _titled(figure: Figure, dataset: xr.Dataset) -> Figure:
    attributes = dataset.attrs
    words = f"{Path(attributes['satellite']).name} and {Path(attributes['reference']).name}"
    if "sign" in attributes:
        sign = attributes["sign"].replace("-", " − ")
        words += f"\n{sign}, epoch {attributes['epoch']:.2f}, clip {attributes['clip']}"
    figure.suptitle(words, fontsize="medium")
    return figure
