"""How a table is to be read, and which of its columns hold what."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from linksweep.core.blocks import PARAMETERS
from linksweep.core.tie.astrometry import PAIRS
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.names import VALUES, error_column, first_found, value_column

EPOCHS = (1700.0, 2300.0)
"""The smallest and the largest epoch that is allowed, Julian years."""

Positions = Literal["single-epoch", "mean"]
Zeros = Literal["error", "missing", "exact"]

NAMES = ("name", "star", "source", "source_id", "designation", "psr_name", "hip", "iers_name", "icrf_name")
CORRELATIONS = tuple(f"{PARAMETERS[i]}_{PARAMETERS[j]}_corr" for i, j in PAIRS)
QUANTITIES = (*VALUES, *(f"{name}_error" for name in PARAMETERS), *CORRELATIONS, "name")
"""The quantities that ``columns`` may name."""

_AT_VIZIER = ("RA", "DE", "Plx", "pmRA", "pmDE")
_CORRELATIONS_AT_VIZIER = {
    name: f"{_AT_VIZIER[i]}{_AT_VIZIER[j]}cor" for name, (i, j) in zip(CORRELATIONS, PAIRS, strict=True)
}


@dataclass(frozen=True)
class TableOptions:
    """How a table is read.

    ``columns`` gives the table's names of quantities, ``units`` the units of quantities whose columns have none.
    ``epoch`` (Julian year) is for a table without a column of epochs.  ``extragalactic``: positions are mean ones of
    quasars, which neither move nor have parallaxes, and hold at any epoch.
    ``positions`` says whether positions without parallax and motion are of a single epoch, displaced by the parallax,
    or mean ones; by default as the table's metadata say, else of a single epoch.  Those without an epoch are mean.
    ``zero_errors``: what an error of 0 means.  ``pmra_cos_dec``: whether pmra is mu_alpha*.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    epoch: float | None = None
    extragalactic: bool = False
    positions: Positions | None = None
    zero_errors: Zeros = "error"
    pmra_cos_dec: bool = True


def require_epoch(epoch: float | None, what: str) -> None:
    """Raise SweepError if an epoch is given and is not an allowed Julian year."""
    if epoch is not None and not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise SweepError(f"{what} {epoch:.10g}: must be a Julian year from {EPOCHS[0]:g} to {EPOCHS[1]:g}")


def unit_of(quantity: str) -> str:
    """Return the unit of numbers without one, other than positions themselves."""
    return "mas/yr" if quantity.startswith("pm") else "mas"


def column_of(quantity: str, names: Collection[str], options: TableOptions) -> str | None:
    """Return the column that holds a quantity; None for none."""
    if quantity in options.columns:
        return options.columns[quantity]
    if quantity in _CORRELATIONS_AT_VIZIER:
        return first_found([quantity, _CORRELATIONS_AT_VIZIER[quantity]], names)
    return value_column(quantity, names)


def error_column_of(quantity: str, names: Collection[str], options: TableOptions) -> str | None:
    """Return the column that holds the error of a quantity; None for none."""
    if f"{quantity}_error" in options.columns:
        return options.columns[f"{quantity}_error"]
    return error_column(quantity, names, column_of(quantity, names, options))


def columns_needed(names: Sequence[str], options: TableOptions, further: Collection[str] = ()) -> list[str]:
    """Return the columns of a table that hold a quantity or are among ``further``, in their order."""
    found = {column_of(quantity, names, options) for quantity in (*VALUES, *CORRELATIONS)}
    found |= {error_column_of(quantity, names, options) for quantity in PARAMETERS}
    return [name for name in names if name in found or name in further]
