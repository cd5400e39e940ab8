"""What a study of the link can set, and what comes out: names, units, defaults and meanings, nothing else."""

from collections.abc import Iterable, Mapping
from typing import Any

from linksweep.core.catalogues import CATALOGUES
from linksweep.core.errors import ERROR_MODELS
from linksweep.core.missions import MISSIONS, mission_from_table
from linksweep.sweep.contract import Output, Parameter

PM = "mas / yr"
PER_MAG = "mas / (yr mag)"
Range = tuple[float | None, float | None]
FROM_0, ANY_SIGN, AT_LEAST_0 = (0.0, 1e6), (-1e6, 1e6), (0.0, None)
MAGNITUDES, UNBOUNDED = (-5.0, 30.0), (None, None)


def _number(
    name: str,
    default: float | None,
    meaning: str,
    unit: str = "",
    limits: Range = FROM_0,
    symbol: str = "",
    **more: Any,
) -> Parameter:
    """Declare a number, by default from 0 to a million."""
    return Parameter(name, "float", default, meaning, unit, (), *limits, symbol=symbol, **more)


def _vector(name: str, size: float, meaning: str, unit: str, largest: float) -> Parameter:
    return Parameter(name, "vector", (size, size, size), meaning, unit, (), -largest, largest)


def choice(name: str, choices: Iterable[str], default: str | None, meaning: str) -> Parameter:
    """Declare one of some words."""
    return Parameter(name, "str", default, meaning, choices=tuple(choices))


def _error_models(side: str) -> list[str]:
    return [name for name, model in ERROR_MODELS.items() if side in model.sides]


ONLY_DIRECTION, SLOPE = "which then gives the direction only", r"$|\mathrm{d}\omega/\mathrm{d}V|$"
PARAMETERS = (
    # step A: the reference catalogue
    choice("catalogue", CATALOGUES, "synthetic", "reference catalogue (step A)"),
    Parameter(
        *("n_obj", "int", None),
        "number of objects; default: all quasars or rows brighter than v_max, 116 galaxies, 11 radio stars",
        minimum=2,
        maximum=10_000_000,
        symbol=r"$N_\mathrm{obj}$",
    ),
    _number(
        *("v_max", None, "limiting magnitude V; default: synthetic 15, quasars 20, galaxies 13.5, else none"),
        *("mag", MAGNITUDES, r"$V_\mathrm{max}$"),
    ),
    _number(
        *("v_min", None, "brightest magnitude V; default: synthetic 5, else none"),
        *("mag", MAGNITUDES, r"$V_\mathrm{min}$"),
    ),
    choice(
        *("counts", ("catalogue", "completed"), "catalogue"),
        "number of quasars: of the paper's catalogue, or completed to the full sky",
    ),
    _number("mean_pm", 0.0, "mean modulus of synthetic proper motions", PM, AT_LEAST_0, r"$\overline{\mu}$"),
    choice("pm_distribution", ("uniform", "constant", "rayleigh"), "uniform", "distribution of that modulus"),
    choice(
        *("positions", ("own", "isotropic"), None),
        "radio stars, file: own positions or random ones; default: radio stars random, file own",
    ),
    _number(
        *("zone_of_avoidance", 0.0, "no random positions at Galactic latitudes |b| below this", "deg"),
        *((0.0, 89.0), r"$|b|_\mathrm{min}$"),
    ),
    _number(
        *("sky_contrast", 0.0, "(north - south)/(north + south) of the Galactic plane, random positions", ""),
        (-0.99, 0.99),
    ),
    Parameter("file", "file", None, "table of objects for catalogue = 'file' (Gaia column names by default)"),
    Parameter("columns", "map", (), "names of the table's columns where they are not Gaia's"),
    Parameter(
        "units", "map", (), "units of quantities whose columns have none: ra = 'hourangle'; default: Gaia's units"
    ),
    Parameter(
        *("pmra_cos_dec", "bool", None),
        "whether pmra of the file includes cos(dec) (its error always does); needed unless the file is Gaia's",
    ),
    # steps C and D: errors
    choice("satellite_errors", _error_models("satellite"), "magnitude", "error model of the satellite (step D)"),
    choice("reference_errors", _error_models("reference"), "none", "error model of the reference (step C)"),
    Parameter(
        *("model", "str", "amex", "mission whose accuracy curve gives the 'magnitude' errors"),
        choices=tuple(MISSIONS),
        symbols={name: name.upper().replace("GAIA-", "Gaia ") for name in MISSIONS},
        define=mission_from_table,
    ),
    _number(
        *("mission_length", None, "mission length; default: the model's own (amex 2, gaia 5)", "yr", UNBOUNDED, "$T$"),
        above=0.0,
    ),
    *(
        _number(f"{side}_sigma_{key}", 1.0, f"{side} {what} error, 'normal' errors", unit, AT_LEAST_0)
        for side in ("satellite", "reference")
        for key, what, unit in (("pos", "position", "mas"), ("pm", "proper-motion", PM))
    ),
    _number("error_scale", 1.0, "factor on all errors"),
    _number("satellite_error_scale", 1.0, "further factor on its errors", symbol=r"$\Delta_\mathrm{sat}$"),
    _number("reference_error_scale", 1.0, "further factor on its errors", symbol=r"$\Delta_\mathrm{ref}$"),
    # the truth (step B)
    _vector("epsilon", 1.0, "true orientation, reference - satellite", "mas", 1e8),
    _vector("omega", 1.0, "true spin, reference - satellite", PM, 1e8),
    *(
        _number(f"{name}_size", None, f"length of {name}, {ONLY_DIRECTION}", unit, (0.0, 1e8), rf"$|\{name}|$")
        for name, unit in (("epsilon", "mas"), ("omega", PM))
    ),
    choice(
        *("directions", ("fixed", "random"), "fixed"),
        "directions of epsilon and omega: as given, or random for each catalogue",
    ),
    Parameter("aberration", "bool", False, "add a glide to the satellite's proper motions (Galactic aberration)"),
    Parameter(
        *("glide", "vector", None, "glide added by aberration; default: 4 uas/yr towards the Galactic centre"),
        "uas / yr",
    ),
    # systematics
    *(
        _number(f"{side}_floor_{key}", 0.0, f"noise floor in its {what} errors, in quadrature after all scales", unit)
        for side in ("satellite", "reference")
        for key, what, unit in (("pos", "position", "mas"), ("pm", "proper-motion", PM))
    ),
    *(
        _number(
            *(f"{side}_error_ratio", 1.0, "its true errors over those in the weights", "", (None, 100.0)), above=0.0
        )
        for side in ("satellite", "reference")
    ),
    _number("zonal_pos", 0.0, "RMS of satellite position errors that neighbours share, not in the weights", "mas"),
    _number("zonal_pm", 0.0, "RMS of such errors of its proper motions, per coordinate", PM),
    _number("zonal_length", 30.0, "width of the Gaussian correlation of zonal errors", "deg", (6.0, 180.0)),
    _vector("omega_slope", 0.0, "change of the true spin with magnitude: omega_slope (V - v_zero)", PER_MAG, 1e6),
    _number("omega_slope_size", None, f"length of omega_slope, {ONLY_DIRECTION}", PER_MAG, FROM_0, SLOPE),
    *(
        _number(
            *(f"magnitude_equation_{motion}", 0.0, f"error of its {motion} per magnitude from v_zero", PER_MAG),
            *(ANY_SIGN, rf"$\mathrm{{d}}\mu_{letter}/\mathrm{{d}}V$"),
        )
        for motion, letter in (("pmra", r"{\alpha*}"), ("pmdec", r"\delta"))
    ),
    _number("v_zero", 15.0, "magnitude without an omega_slope or magnitude equation", "mag", MAGNITUDES),
    Parameter(
        *("motion_field", "str", None),
        "vector spherical harmonics in the satellite's proper motions, as 't_2_0=0.1,s_2_1_re=-0.2' in mas/yr",
    ),
    _number("motion_field_size", None, "RMS of motion_field over the sky, which then gives the pattern only", PM),
    # step E: the solution
    Parameter("solve_glide", "bool", False, "solve for a glide too"),
    Parameter("corrections", "bool", True, "keep the A21 terms in the design matrix"),
    choice(
        *("weighting", ("inverse-variance", "equal"), "inverse-variance"),
        "weights of the solution: 1/(sigma_ref^2 + sigma_sat^2), or all equal",
    ),
    choice(
        *("arithmetic", ("exact", "stored"), "exact"),
        "differences of catalogues: exact, or by subtracting stored angles as in the paper",
    ),
    choice(
        *("method", ("catalogue", "projected"), "catalogue"),
        "what is drawn: the errors of every object, or (projected) their effect on the link, at a cost without n_obj",
    ),
)

NOT_SHARED = frozenset(
    # They make other objects from the same numbers, so that nothing is left to compare; method draws other numbers.
    {"catalogue", "n_obj", "counts", "positions", "file", "columns", "units", "pmra_cos_dec", "method"}
)
# Parameters whose values do not change the random numbers of a block, only what is computed from them.
#
# Most act on what is computed from the normals: gains, weights and units of the errors.  Each side draws its normals
# from a stream of its own, so a side without errors does not change those of the other; the truth draws only its
# directions, and zonal errors those of a wider kernel from the first numbers of a narrower one, again from other
# streams.  For v_min, mean_pm, pm_distribution, zone_of_avoidance and sky_contrast the same uniform numbers become
# other positions, magnitudes or motions of the same objects.  Quasars to a brighter v_max (at half magnitudes) are the
# first of those to a fainter one; in other catalogues only magnitudes change, and a file gives some of the same rows.
SHARED = tuple(parameter.name for parameter in PARAMETERS if parameter.name not in NOT_SHARED)

UNITS = ("mas",) * 3 + (PM,) * 3
# No slashes: astropy warns about several in one string.
_EACH = "mas, mas, mas, mas yr-1, mas yr-1, mas yr-1"
_TOP = "(mas2, mas2, mas2, mas2 yr-1, mas2 yr-1, mas2 yr-1)"
_BOTTOM = "(mas2 yr-1, mas2 yr-1, mas2 yr-1, mas2 yr-2, mas2 yr-2, mas2 yr-2)"
_PRODUCTS = ", ".join([_TOP] * 3 + [_BOTTOM] * 3)
_COMPONENT, _PAIR, _GLIDE = ("component",), ("component", "component_other"), ("glide_component",)


_PREDICTION, _OF_MEANS = "closed-form prediction of {} for the same catalogues", "; NaN for 2 to 4 catalogues"
_BIAS = {"predicted": _PREDICTION, "mc_error": f"Monte-Carlo error of {{}}{_OF_MEANS}"}
_SIGMA = {
    "mc_error": "Monte-Carlo error of {} for these catalogues",
    "predicted": f"{_PREDICTION}, from the errors alone, without the bias",
    "rms_predicted": f"{_PREDICTION}, from errors and bias together",
    "catalogue_error": "error of {} as the mean over all possible catalogues; NaN for n_cat below 5",
}


def with_beside(
    beside: Mapping[str, str], name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), **more: Any
) -> list[Output]:
    """Declare a result that may be NaN, with what stands beside it."""
    others = (Output(f"{name}_{key}", unit, text.format(name), dims, nan=True) for key, text in beside.items())
    return [Output(name, unit, meaning, dims, nan=True, **more), *others]


OUTPUTS = (
    Output("n_obj", "", "number of objects in the catalogue (mean over catalogues)", (), True, r"$N_\mathrm{obj}$"),
    *with_beside(
        *(_SIGMA, "sigma_spin", PM, "RMS error of the spin, over its components"),
        headline=True,
        symbol=r"$\sigma(\omega)$",
    ),
    *with_beside(
        *(_SIGMA, "sigma_orientation", "mas", "RMS error of the orientation, over its components"),
        symbol=r"$\sigma(\epsilon)$",
    ),
    *with_beside(_SIGMA, "sigma", _EACH, "RMS of estimate - truth", _COMPONENT),
    *with_beside(_BIAS, "bias", _EACH, "mean of estimate - truth", _COMPONENT),
    Output("covariance", _PRODUCTS, "covariance of the estimates about their mean", _PAIR, nan=True),
    Output("correlation", "", "correlation of the estimates about their mean", _PAIR, nan=True),
    Output("condition_number", "", "condition of the normal matrix scaled to a diagonal of 1 (mean over catalogues)"),
    Output("condition_number_mc_error", "", f"Monte-Carlo error of condition_number{_OF_MEANS}", nan=True),
    Output("chi2", "", "mean chi2 of the solution; dof if weights are those of uncorrelated errors"),
    Output("chi2_mc_error", "", f"Monte-Carlo error of chi2{_OF_MEANS}", nan=True),
    Output("dof", "", "degrees of freedom of chi2 (mean over catalogues)"),
    *with_beside(_SIGMA, "glide_sigma", PM, "RMS of estimate - truth of a glide that was solved for", _GLIDE),
    *with_beside(_BIAS, "glide_bias", PM, "mean of estimate - truth of a glide that was solved for", _GLIDE),
)

_ESTIMATE = "estimate of each realisation, where a study keeps them; estimate - truth where directions are random"
SAMPLE_OUTPUTS = (Output("estimate", _EACH, _ESTIMATE, _COMPONENT, nan=True),)
