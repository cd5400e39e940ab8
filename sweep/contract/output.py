"""A declared output of an experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Output:
    """One result of a point.  An output of a plain function (`linksweep.experiment`) needs only a name.

    Args:
        name: the name of the variable in the dataset.
        unit: as astropy writes it.
        meaning: one line for tables and figures.
        dims: dimensions besides those of the grid; a single one may be a string.
        headline: whether it is a column of the printed table and comes first in reports and figures.
        errors: the names of further outputs with the same dimensions that are its one-sigma errors, of several kinds;
            tables and reports show each beside it.
        symbol: what figures show instead of the name, in the notation of Matplotlib.
        nan: whether NaN and infinity are allowed; otherwise a point with such a value fails.
        coords: for a plain function, the coordinate of each dimension: values or (values, unit), where values are
            numbers, texts or times.
        statistics: for a plain function that draws random numbers, what is computed from its realisations: "mean",
            "std", "min", "max", "count" (how many are true), "median" and quantiles such as "q95".
    """

    name: str
    unit: str = ""
    meaning: str = ""
    dims: tuple[str, ...] | str = ()
    headline: bool = False
    symbol: str = ""
    nan: bool = False
    coords: Mapping[str, Any] | None = field(default=None, compare=False)
    statistics: Sequence[str] = field(default=(), compare=False)
    errors: Sequence[str] = ()
