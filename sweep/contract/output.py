"""A declared output of an experiment."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Output:
    """One result of a point: its unit (as astropy writes it), meaning and dimensions beside the axes of the grid.

    ``headline`` outputs are the columns of the printed table; pictures show the ``symbol`` where there is one.  A
    number that is NaN or infinite fails its point unless ``nan`` says that it is a value.
    """

    name: str
    unit: str
    meaning: str
    dims: tuple[str, ...] = ()
    headline: bool = False
    symbol: str = ""
    nan: bool = False
