"""The options of a link of tables: how each table is read, and what is solved for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from linksweep.core.tie.problem import Weights
from linksweep.core.unknowns import require_mission_name
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.tables.columns import EPOCHS

Positions = Literal["single-epoch", "mean"]
Zeros = Literal["error", "missing", "exact"]
Sign = Literal["reference-satellite", "satellite-reference"]
SIGNS: Mapping[Sign, float] = {"reference-satellite": 1.0, "satellite-reference": -1.0}


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


@dataclass(frozen=True)
class Options:
    """The options of a link of two or more tables.

    ``unknowns`` as in `parse_unknowns`, None for those of orientation and spin that the tables determine; ``degree``
    adds vector spherical harmonics up to it.  ``bins`` are a column and edges.  ``epoch`` (Julian year) is that of the
    orientation, by default the satellite's.  ``known_spin`` is a vector (mas/yr, in the sign of ``sign``) or the path
    of a table by magnitude.  ``jitter`` maps kinds of rows to (mas, mas/yr) added in quadrature.  ``aberration``
    (uas/yr) carries reference positions without an epoch from 2015.0 to the satellite's epoch.  ``missions`` are
    further tables by name, each in a frame of its own with an orientation and a spin; ``mission_options`` say how
    these are read.
    """

    unknowns: str | None = None
    degree: int | None = None
    bins: tuple[str, Sequence[float]] | None = None
    by: str | None = None
    epoch: float | None = None
    weights: Weights = "covariance"
    known_spin: Sequence[float] | str | Path | None = None
    jitter: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sign: Sign = "reference-satellite"
    corrections: bool = True
    aberration: float = 0.0
    missions: Mapping[str, str | Path] = field(default_factory=dict)
    satellite_options: TableOptions = field(default_factory=TableOptions)
    reference_options: TableOptions = field(default_factory=TableOptions)
    mission_options: Mapping[str, TableOptions] = field(default_factory=dict)

    def check(self) -> None:
        """Raise SweepError for values that are not allowed."""
        for name, choices in (("sign", tuple(SIGNS)), ("weights", get_args(Weights))):
            if (value := getattr(self, name)) not in choices:
                raise SweepError(f"{name} {value!r}: must be {' or '.join(choices)}")
        if not np.isfinite(self.aberration) or self.aberration < 0.0:
            raise SweepError(f"aberration {self.aberration:g} uas/yr: must be finite and not negative")
        of_tables = (self.satellite_options, self.reference_options, *self.mission_options.values())
        epochs = [(self.epoch, "the orientation"), *((table.epoch, "a table") for table in of_tables)]
        for epoch, whose in epochs:
            if epoch is not None and not EPOCHS[0] <= epoch <= EPOCHS[1]:
                limits = f"must be a Julian year from {EPOCHS[0]:g} to {EPOCHS[1]:g}"
                raise SweepError(f"epoch of {whose} {epoch:.10g}: {limits}")
        if self.degree is not None and self.degree < 1:
            raise SweepError(f"degree {self.degree}: must be at least 1")
        for name in self.missions:
            try:
                require_mission_name(name)
            except ValueError as error:
                raise SweepError(str(error)) from error
        if unknown := sorted(set(self.mission_options) - set(self.missions)):
            raise SweepError(f"options of {', '.join(unknown)}: no such mission")

    def jitter_in(self, mission: str | None) -> dict[str, tuple[float, float]]:
        """Return the jitter by kind of row of the reference, or of a mission: ``hipparcos:position``."""
        chosen = {}
        for key, size in self.jitter.items():
            table, colon, kind = key.rpartition(":")
            if (table if colon else None) == mission:
                chosen[kind] = size
            elif colon and table not in self.missions:
                raise SweepError(f"jitter of {key!r}: no mission {table!r}")
        return chosen


def parse_bins(text: str) -> tuple[str, list[float]]:
    """Return the column and the edges of a text like phot_g_mean_mag=6,8,10; raises SweepError for any other text."""
    column, edges = split_assignment(text)
    try:
        numbers = [float(part) for part in edges.split(",")]
    except ValueError:
        numbers = []
    if not (column and numbers):
        raise SweepError(f"bins {text!r}: must be written COLUMN=EDGE,EDGE and so on")
    return column, numbers
