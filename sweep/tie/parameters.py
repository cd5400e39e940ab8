"""The parameters of a study of a link, its outputs, and where unknowns stand in them: degree 1 by component, harmonics
by degree, spins by bin.
"""

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from linksweep.core.frames import MAS, Array
from linksweep.core.tie.forecast import RELEASES
from linksweep.core.unknowns import SpinByBin, Unknowns, parse_unknowns
from linksweep.sweep.contract import Output, Parameter
from linksweep.sweep.tie.options import Positions
from linksweep.sweep.tie.solution import FIELD_OF, spectrum

TABLE = "table"
"""Stands for what a table itself has: its errors, or the release whose epoch it has."""

_STORED = parse_unknowns("orientation,spin,position_glide,glide,parallax")
COMPONENTS = _STORED.labels
"""The unknowns of degree 1 and the zero point of parallaxes."""

UNITS = _STORED.units
ORIENTATION, SPIN = slice(0, 3), slice(3, 6)

FIELDS = tuple(FIELD_OF.values())
FIELD_UNITS = tuple("mas2/yr2" if field.startswith("motion") else "mas2" for field in FIELDS)
HIGHEST_STORED = 10
MOST_BINS = 10
POWER_SHAPE, BIN_SHAPE = (len(FIELDS), HIGHEST_STORED), (MOST_BINS, 3)


def _epoch(name: str, meaning: str) -> Parameter:
    return Parameter(name, "float", None, meaning, "yr", minimum=1800.0, maximum=2200.0)


def _size(name: str, default: float, meaning: str, unit: str = "", **limits: Any) -> Parameter:
    return Parameter(name, "float", default, meaning, unit, **(limits or {"minimum": 0.0}))


def _one(name: str, default: str, meaning: str, *choices: str) -> Parameter:
    return Parameter(name, "str", default, meaning, choices=(default, *choices))


_JITTER = "added in quadrature to the reference's"
_BY = "how rows are matched: name, COLUMN, position[:ARCSEC]; default name if possible"
_NO_COLUMN = "of a table without a column of epochs"
PARAMETERS = (
    Parameter("satellite", "file", None, "table of the satellite; required"),
    Parameter("reference", "file", None, "table of the reference; without one the rows are those of n_new"),
    Parameter("zero_motion", "bool", False, "sources are quasars, which do not move; no table of the reference"),
    Parameter("unknowns", "str", "orientation,spin", "blocks that are solved for, as in sweep tie --unknowns"),
    Parameter("degree", "int", None, "adds vector spherical harmonics up to this; default none", minimum=1, maximum=50),
    Parameter(
        "bins", "str", "", f"a spin for each bin of a column, like phot_g_mean_mag=6,8,10; at most {MOST_BINS} bins"
    ),
    Parameter("clip", "str", "none", "none, rayleigh, median:K, discrepancy[:N] or huber:C"),
    _one("weights", "covariance", "of the differences", "variance", "equal"),
    Parameter("correlations", "bool", True, "whether the errors have the correlations of the tables"),
    Parameter("g_min", "float", None, "brightest magnitude; default no limit", "mag"),
    Parameter("g_max", "float", None, "faintest magnitude; default no limit", "mag"),
    Parameter("magnitude", "str", "phot_g_mean_mag", "the satellite's column of magnitudes"),
    _epoch("epoch", "of the orientation; default the satellite's"),
    _one("release", TABLE, "errors of a later release, with its epoch", *RELEASES),
    _one("from_release", TABLE, "of the satellite's errors, if no release has its epoch", *RELEASES),
    Parameter("n_new", "int", 0, "sources with one new position, those that help most", minimum=0),
    _epoch("new_epoch", "of new positions; default that of the source"),
    _size("new_error", 0.1, "of each coordinate of a new position", "mas", above=0.0),
    _one("new_positions", "single-epoch", "of new rows: displaced by the parallax, or mean ones", "mean"),
    Parameter("goal", "str", "", "blocks for which new positions are chosen; default all"),
    _one("candidates", "matched", "for new positions: sources with rows, or all of the satellite's", "all"),
    _size("position_jitter", 0.0, f"{_JITTER} positions", "mas"),
    _size("motion_jitter", 0.0, f"{_JITTER} motions", "mas/yr"),
    Parameter("known_spin", "vector", None, "subtracted before the fit, reference - satellite; default none", "mas/yr"),
    _size("aberration", 0.0, "Galactic, carries positions without an epoch from 2015.0", "uas/yr"),
    Parameter("by", "str", "", _BY),
    Parameter("satellite_columns", "map", (), "the satellite's names of columns"),
    Parameter("reference_columns", "map", (), "the reference's names of columns"),
    _epoch("satellite_epoch", _NO_COLUMN),
    _epoch("reference_epoch", _NO_COLUMN),
    _one(
        "positions",
        TABLE,
        "the reference's: of a single epoch or mean; default what the table says",
        *get_args(Positions),
    ),
    _one(
        "extragalactic",
        "none",
        "the table with mean positions of quasars, which hold at any epoch",
        *("satellite", "reference", "both"),
    ),
    Parameter("accept_misfit", "bool", False, "computes points whose tables have chi2 above 1000 times its average"),
    _one("zero_errors", "error", "what an error of 0 means", "missing", "exact"),
    _one("truth", "estimate", "of the draws: the solution of the tables, or zero", "zero"),
    _size("error_factor", 1.0, "errors of the draws over those of the tables", above=0.0),
    _size("outliers", 0.0, "fraction of sources of a draw with larger errors", minimum=0.0, maximum=1.0),
    _size("outlier_factor", 10.0, "how much larger they are", minimum=1.0),
)

_UNITS, _SQUARES = ", ".join(UNITS), ", ".join(FIELD_UNITS)
_EACH, _RATIO = ("component",), ("unknown",)  # units differ along the first only
_POWER, _CHANCE = ("field", "power_degree"), ("field_tested", "power_degree")
_BIN = ("bin", "axis")


def _drawn(
    name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), predicted: bool = True, **further: Any
) -> list[Output]:
    """Declare a result of the draws, its Monte-Carlo error and, where there is one, its closed form."""
    beside = {"mc_error": "its Monte-Carlo error"} | ({"predicted": "closed form without a clip"} if predicted else {})
    return [
        Output(name, unit, meaning, dims, nan=True, **further),
        *(Output(f"{name}_{key}", unit, text, dims, nan=True) for key, text in beside.items()),
    ]


def _fixed(name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), *errors: str) -> Output:
    """Declare a result of the tables as they are; one with ``errors`` is a headline."""
    return Output(name, unit, meaning, dims, headline=bool(errors), nan=True, errors=errors)


_RMS, _WITHIN, _AS_IS = "RMS of estimate - truth of the draws", "error of the truth", "of the tables as they are"
OUTPUTS = (
    Output("n_sources", "", "matched sources of the tables, within g_min and g_max"),
    _fixed("n_kept", "", f"sources that the clip keeps, {_AS_IS}"),
    _fixed(
        *("estimate", _UNITS, "solution of the tables as they are, reference - satellite", _EACH),
        *("error_scaled", "error_jackknife", "error_formal"),
    ),
    _fixed("error_formal", _UNITS, "its formal error", _EACH),
    _fixed("error_scaled", _UNITS, "its formal error times sqrt(chi2/dof)", _EACH),
    _fixed("error_jackknife", _UNITS, "its error from the solutions without each source", _EACH),
    Output("chi2_ratio", "", "chi2 of the tables over its average, 1 if errors are right", (), True, nan=True),
    _fixed("largest_share", "", "largest share of one source in the weight of a block of unknowns"),
    *_drawn("sigma", _UNITS, _RMS, _EACH),
    *_drawn("bias", _UNITS, "mean of estimate - truth of the draws", _EACH, False),
    *_drawn("coverage", "", f"fraction of draws within their formal {_WITHIN}", _RATIO, False),
    *_drawn("coverage_scaled", "", f"fraction of draws within their scaled {_WITHIN}", _RATIO, False),
    *_drawn(
        *("sigma_orientation", "mas", "RMS error of the orientation, over draws and axes"),
        headline=True,
        symbol=r"$\sigma_\epsilon$",
    ),
    *_drawn(
        "sigma_spin", "mas/yr", "RMS error of the spin, over draws and axes", headline=True, symbol=r"$\sigma_\omega$"
    ),
    _fixed("power", _SQUARES, f"of harmonics of degree 1 to {HIGHEST_STORED}, {_AS_IS}", _POWER),
    _fixed("power_noise", _SQUARES, "mean power for noise alone, from the formal errors", _POWER),
    _fixed("power_probability", "", "probability that noise gives as significant a power", _CHANCE),
    *_drawn("power_drawn", _SQUARES, "mean power of estimate - truth of the draws", _POWER),
    _fixed("spin_by_bin", "mas/yr", f"spin in each bin, {_AS_IS}", _BIN, "spin_by_bin_error"),
    _fixed("spin_by_bin_error", "mas/yr", "its scaled error", _BIN),
    *_drawn("sigma_by_bin", "mas/yr", _RMS, _BIN),
    Output("n_drawn", "", "sources that are simulated"),
    Output("n_kept_drawn", "", "mean number of these that the clip keeps"),
    *_drawn("chi2_ratio_drawn", "", "mean of chi2 over its average, of the draws", predicted=False),
)

SAMPLE_OUTPUTS = (Output("drawn", "", "estimate of a draw, reference - satellite", _EACH, nan=True),)


def components(values: Array, labels: Sequence[str]) -> Array:
    """Return values (..., K) at the places of their labels among `COMPONENTS`, NaN elsewhere."""
    placed = np.full((*values.shape[:-1], len(COMPONENTS)), np.nan)
    for i, label in enumerate(labels):
        if label in COMPONENTS:
            placed[..., COMPONENTS.index(label)] = values[..., i]
    return placed


def powers(unknowns: Unknowns, estimate: Array, covariance: Array) -> Array:
    """Return the power of each field and degree of an estimate in rad, its mean for noise alone, and the
    probability that noise is as significant; shape (3, fields, degrees), in mas2 and mas2/yr2, NaN if not solved for.
    """
    stored = np.full((3, *POWER_SHAPE), np.nan)
    for one in spectrum(unknowns, estimate / MAS, covariance / MAS**2):
        if one.degree <= HIGHEST_STORED:
            stored[:, FIELDS.index(one.field), one.degree - 1] = one.power, one.noise, one.probability
    return stored


def by_bins(unknowns: Unknowns, values: Array) -> Array:
    """Return values (..., K) of the spin in each bin; shape (..., bins, 3), NaN without bins and beyond the last."""
    stored = np.full((*values.shape[:-1], *BIN_SHAPE), np.nan)
    for block in unknowns.blocks:
        if isinstance(block, SpinByBin):
            if max(block.used) >= MOST_BINS:
                raise ValueError(f"bins: results hold {MOST_BINS} bins at most, the edges make {len(block.edges) + 1}")
            spins = values[..., unknowns.part(block.name)]
            stored[..., list(block.used), :] = spins.reshape(*values.shape[:-1], len(block.used), 3)
    return stored


def is_stored(unknowns: Unknowns) -> bool:
    """Return whether results have a place for any of the unknowns."""
    parts = components(np.zeros(len(unknowns)), unknowns.labels), by_bins(unknowns, np.zeros(len(unknowns)))
    stored = powers(unknowns, np.zeros(len(unknowns)), np.eye(len(unknowns)))[0]
    return any(np.any(np.isfinite(part)) for part in (*parts, stored))
