"""How a table is to be read, and which of its columns hold what."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from core.blocks import PARAMETERS
from core.tie.astrometry import PAIRS
from sweep.contract import SweepError
from sweep.tables.names import VALUES, error_column, first_found, value_column

EPOCHS = (1700.0, 2300.0)
"""Julian years that an epoch may be."""

Positions = Literal["single-epoch", "mean"]
Zeros = Literal["error", "missing", "exact"]

NAMES = ("name", "star", "source", "source_id", "designation", "psr_name", "hip", "iers_name", "icrf_name")
CORRELATIONS = tuple(f"{PARAMETERS[i]}_{PARAMETERS[j]}_corr" for i, j in PAIRS)
QUANTITIES = (*VALUES, *(f"{name}_error" for name in PARAMETERS), *CORRELATIONS, "name")
"""All that ``columns`` may name."""

_AT_VIZIER = ("RA", "DE", "Plx", "pmRA", "pmDE")
_CORRELATIONS_AT_VIZIER = {
    name: f"{_AT_VIZIER[i]}{_AT_VIZIER[j]}cor" for name, (i, j) in zip(CORRELATIONS, PAIRS, strict=True)
}


@dataclass(frozen=True)
class TableOptions:
    """How a table is read.

    ``columns``: the table's name for a quantity; ``units``: of quantities whose column says none.  ``epoch`` (Julian
    year) is for a table without a column of epochs.
    ``positions`` without parallax and motion: of a single epoch, displaced by the parallax, or mean ones; by default
    what the table's metadata say under ``positions``, else of a single epoch.  Those without an epoch are mean ones.
    ``zero_errors``: what an error of 0 means.  ``pmra_cos_dec``: whether pmra is mu_alpha*.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    epoch: float | None = None
    positions: Positions | None = None
    zero_errors: Zeros = "error"
    pmra_cos_dec: bool = True


def require_epoch(epoch: float | None, what: str) -> None:
    """Raise SweepError for what is no Julian year, if it is given."""
    if epoch is not None and not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise SweepError(f"{what} {epoch:.10g}: it is a Julian year from {EPOCHS[0]:g} to {EPOCHS[1]:g}")


def unit_of(quantity: str) -> str:
    """Return the unit of plain numbers, but positions."""
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
    """Return the columns of a table that hold a quantity, in their order, and ``further`` ones."""
    found = {column_of(quantity, names, options) for quantity in (*VALUES, *CORRELATIONS)}
    found |= {error_column_of(quantity, names, options) for quantity in PARAMETERS}
    return [name for name in names if name in found or name in further]
