"""A declared output of an experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Output:
    """One result of a point: its unit (as astropy writes it), meaning and dimensions beside the axes of the grid.

    ``headline`` outputs are the columns of the printed table; pictures show the ``symbol`` where there is one.  A
    number that is NaN or infinite fails its point unless ``nan`` says that it is a value.

    Of a plain function (`linksweep.experiment`) only the name is needed.  One dimension may be a string; ``coords``
    gives the coordinate of each, values or (values, unit), of numbers, texts or times.  Where the function draws random
    numbers, ``statistics`` are what is made of its realisations: "mean", "std", "min", "max", "count" (of those that
    are true), and quantiles such as "q95".
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
