"""The parameters of a study of a link, and its outputs."""

from linksweep.core.tie.forecast import RELEASES
from linksweep.sweep.contract import Output, Parameter
from linksweep.sweep.tie.components import FIELD_UNITS, HIGHEST_STORED, MOST_BINS, UNITS

TABLE = "table"
"""Stands for what a table itself has: its errors, or the release whose epoch it has."""


def _epoch(name: str, meaning: str) -> Parameter:
    return Parameter(name, "float", None, meaning, "yr", minimum=1800.0, maximum=2200.0)


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
    Parameter("weights", "str", "covariance", "of the differences", choices=("covariance", "variance", "equal")),
    Parameter("correlations", "bool", True, "whether the errors have the correlations of the tables"),
    Parameter("g_min", "float", None, "brightest magnitude; default no limit", "mag"),
    Parameter("g_max", "float", None, "faintest magnitude; default no limit", "mag"),
    Parameter("magnitude", "str", "phot_g_mean_mag", "the satellite's column of magnitudes"),
    _epoch("epoch", "of the orientation; default the satellite's"),
    Parameter("release", "str", TABLE, "errors of a later release, with its epoch", choices=(TABLE, *RELEASES)),
    Parameter(
        "from_release",
        "str",
        TABLE,
        "of the satellite's errors, if no release has its epoch",
        choices=(TABLE, *RELEASES),
    ),
    Parameter("n_new", "int", 0, "sources with one new position, those that help most", minimum=0),
    _epoch("new_epoch", "of new positions; default that of the source"),
    Parameter("new_error", "float", 0.1, "of each coordinate of a new position", "mas", above=0.0),
    Parameter(
        "new_positions",
        "str",
        "single-epoch",
        "of new rows: displaced by the parallax, or mean ones",
        choices=("single-epoch", "mean"),
    ),
    Parameter("goal", "str", "", "blocks for which new positions are chosen; default all"),
    Parameter(
        "candidates",
        "str",
        "matched",
        "for new positions: sources with rows, or all of the satellite's",
        choices=("matched", "all"),
    ),
    Parameter("position_jitter", "float", 0.0, "added in quadrature to the reference's positions", "mas", minimum=0.0),
    Parameter("motion_jitter", "float", 0.0, "added in quadrature to the reference's motions", "mas/yr", minimum=0.0),
    Parameter("known_spin", "vector", None, "subtracted before the fit, reference - satellite; default none", "mas/yr"),
    Parameter(
        "aberration", "float", 0.0, "Galactic, carries positions without an epoch from 2015.0", "uas/yr", minimum=0.0
    ),
    Parameter("by", "str", "", "how rows are matched: name, COLUMN, position[:ARCSEC]; default name if possible"),
    Parameter("satellite_columns", "map", (), "the satellite's names of columns"),
    Parameter("reference_columns", "map", (), "the reference's names of columns"),
    _epoch("satellite_epoch", "of a table without a column of epochs"),
    _epoch("reference_epoch", "of a table without a column of epochs"),
    Parameter(
        "positions",
        "str",
        "table",
        "the reference's: of a single epoch or mean; default what the table says",
        choices=("table", "single-epoch", "mean"),
    ),
    Parameter(
        "extragalactic",
        "str",
        "none",
        "the table with mean positions of quasars, which hold at any epoch",
        choices=("none", "satellite", "reference", "both"),
    ),
    Parameter("accept_misfit", "bool", False, "computes points whose tables have chi2 above 1000 times its average"),
    Parameter("zero_errors", "str", "error", "what an error of 0 means", choices=("error", "missing", "exact")),
    Parameter(
        "truth", "str", "estimate", "of the draws: the solution of the tables, or zero", choices=("estimate", "zero")
    ),
    Parameter("error_factor", "float", 1.0, "errors of the draws over those of the tables", above=0.0),
    Parameter("outliers", "float", 0.0, "fraction of sources of a draw with larger errors", minimum=0.0, maximum=1.0),
    Parameter("outlier_factor", "float", 10.0, "how much larger they are", minimum=1.0),
)

_UNITS, _SQUARES = ", ".join(UNITS), ", ".join(FIELD_UNITS)
_EACH, _RATIO = ("component",), ("unknown",)  # units differ along the first only
_POWER, _CHANCE = ("field", "power_degree"), ("field_tested", "power_degree")
_BIN = ("bin", "axis")


def _with_errors(
    name: str,
    unit: str,
    meaning: str,
    dims: tuple[str, ...] = (),
    headline: bool = False,
    symbol: str = "",
    predicted: bool = True,
) -> list[Output]:
    """Declare a result of the draws, its Monte-Carlo error and, where there is one, its closed form."""
    beside = {"mc_error": "its Monte-Carlo error"} | ({"predicted": "closed form without a clip"} if predicted else {})
    return [
        Output(name, unit, meaning, dims, headline, symbol, nan=True),
        *(Output(f"{name}_{key}", unit, text, dims, nan=True) for key, text in beside.items()),
    ]


OUTPUTS = (
    Output("n_sources", "", "matched sources of the tables, within g_min and g_max"),
    Output("n_kept", "", "sources that the clip keeps, of the tables as they are", nan=True),
    Output(
        "estimate",
        _UNITS,
        "solution of the tables as they are, reference - satellite",
        _EACH,
        headline=True,
        nan=True,
        errors=("error_scaled", "error_jackknife", "error_formal"),
    ),
    Output("error_formal", _UNITS, "its formal error", _EACH, nan=True),
    Output("error_scaled", _UNITS, "its formal error times sqrt(chi2/dof)", _EACH, nan=True),
    Output("error_jackknife", _UNITS, "its error from the solutions without each source", _EACH, nan=True),
    Output("chi2_ratio", "", "chi2 of the tables over its average, 1 if errors are right", (), True, nan=True),
    Output("largest_share", "", "largest share of one source in the weight of a block of unknowns", nan=True),
    *_with_errors("sigma", _UNITS, "RMS of estimate - truth of the draws", _EACH),
    *_with_errors("bias", _UNITS, "mean of estimate - truth of the draws", _EACH, predicted=False),
    *_with_errors("coverage", "", "fraction of draws within their formal error of the truth", _RATIO, predicted=False),
    *_with_errors(
        "coverage_scaled", "", "fraction of draws within their scaled error of the truth", _RATIO, predicted=False
    ),
    *_with_errors(
        "sigma_orientation", "mas", "RMS error of the orientation, over draws and axes", (), True, r"$\sigma_\epsilon$"
    ),
    *_with_errors("sigma_spin", "mas/yr", "RMS error of the spin, over draws and axes", (), True, r"$\sigma_\omega$"),
    Output(
        "power", _SQUARES, f"of harmonics of degree 1 to {HIGHEST_STORED}, of the tables as they are", _POWER, nan=True
    ),
    Output("power_noise", _SQUARES, "mean power for noise alone, from the formal errors", _POWER, nan=True),
    Output("power_probability", "", "probability that noise gives as significant a power", _CHANCE, nan=True),
    *_with_errors("power_drawn", _SQUARES, "mean power of estimate - truth of the draws", _POWER),
    Output(
        "spin_by_bin",
        "mas/yr",
        "spin in each bin, of the tables as they are",
        _BIN,
        headline=True,
        nan=True,
        errors=("spin_by_bin_error",),
    ),
    Output("spin_by_bin_error", "mas/yr", "its scaled error", _BIN, nan=True),
    *_with_errors("sigma_by_bin", "mas/yr", "RMS of estimate - truth of the draws", _BIN),
    Output("n_drawn", "", "sources that are simulated"),
    Output("n_kept_drawn", "", "mean number of these that the clip keeps"),
    *_with_errors("chi2_ratio_drawn", "", "mean of chi2 over its average, of the draws", predicted=False),
)

SAMPLE_OUTPUTS = (Output("drawn", "", "estimate of a draw, reference - satellite", _EACH, nan=True),)
