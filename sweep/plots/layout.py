"""Which dimensions of a quantity become colours, and which become columns and rows of panels."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.style import COLOURS

MOST_SERIES = len(COLOURS)
MOST_PANELS = 24
FAR = 30.0
"""Series whose medians differ by more than this factor need panels with axes of their own."""


@dataclass(frozen=True)
class Layout:
    """Dimensions of a picture: ``series`` become colours of one panel, ``columns`` and ``rows`` panels.

    ``far`` is true if columns differ so much that each needs a scale of its own.
    """

    series: tuple[str, ...] = ()
    columns: str | None = None
    rows: str | None = None
    far: bool = False


def arrange(dataset: xr.Dataset, variable: str, along: tuple[str, ...], series: bool = True) -> Layout:
    """Return the layout of the dimensions of a variable other than those it is drawn ``along``.

    The dimension along which values differ most becomes columns, if there are several or values differ by more than
    `FAR`.  The others become colours, and one of them rows if there are three or more.  With ``series = False`` none
    becomes colours.  Raises SweepError where there are more colours or panels than can be told apart.
    """
    array = dataset[variable]
    others = [str(d) for d in array.dims if d not in along and array.sizes[d] > 1]
    apart = {d: _separation(array, d) for d in others}
    by_separation = sorted(others, key=lambda d: -apart[d])
    widest = by_separation[0] if others else None
    far = widest is not None and apart[widest] > FAR and array.sizes[widest] <= MOST_SERIES
    if not series:
        if len(others) > 2:
            names = ", ".join(by_separation)
            raise SweepError(f"{len(others)} dimensions are left for panels, {names}; fix some with --at AXIS=VALUE")
        columns, rows = (*by_separation, None, None)[:2]
        layout = Layout((), columns, rows)
    elif len(others) <= 1:
        layout = Layout(columns=widest, far=True) if far else Layout(tuple(others))
    else:
        rest = by_separation[1:]
        rows = min(rest, key=lambda d: (array[d].dtype.kind not in "if", array.sizes[d])) if len(others) > 2 else None
        layout = Layout(tuple(d for d in others if d not in (widest, rows)), widest, rows, far)
    _require_few(array, layout)
    return layout


def _separation(array: xr.DataArray, dimension: str) -> float:
    """Return the ratio between the largest and the smallest of the medians along a dimension."""
    medians = np.abs(array.median([d for d in array.dims if d != dimension], skipna=True).values)
    medians = medians[np.isfinite(medians) & (medians > 0.0)]
    return float(medians.max() / medians.min()) if medians.size else 1.0


def is_far(array: xr.DataArray, dimension: str) -> bool:
    """Return whether values differ so much along a dimension that they need axes of their own."""
    return _separation(array, dimension) > FAR


def _require_few(array: xr.DataArray, layout: Layout) -> None:
    n_series = int(np.prod([array.sizes[d] for d in layout.series], dtype=int))
    panels = [d for d in (layout.columns, layout.rows) if d is not None]
    n_panels = int(np.prod([array.sizes[d] for d in panels], dtype=int))
    if n_series > MOST_SERIES or n_panels > MOST_PANELS:
        sizes = ", ".join(f"{d} ({array.sizes[d]})" for d in (*layout.series, *panels))
        raise SweepError(
            f"{sizes}: {n_panels} panels of {n_series} series are too many for one picture, at most {MOST_PANELS} of "
            f"{MOST_SERIES}; fix some with --at AXIS=VALUE"
        )
