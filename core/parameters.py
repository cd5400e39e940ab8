"""The parameters that a study of the link can set: names, units, defaults and meanings, nothing else."""

from collections.abc import Iterable

from linksweep.core.catalogues import CATALOGUES
from linksweep.core.errors import error_kinds
from linksweep.core.missions import MISSIONS
from linksweep.core.systematics import Vector
from linksweep.core.user_mission import mission_from_table
from linksweep.sweep.contract import Parameter


def _choice(name: str, default: str | None, meaning: str, choices: Iterable[str]) -> Parameter:
    return Parameter(name, "str", default, meaning, choices=tuple(choices))


def _number(
    name: str,
    default: float | None,
    meaning: str,
    unit: str = "",
    minimum: float | None = 0.0,
    maximum: float | None = 1e6,
    symbol: str = "",
) -> Parameter:
    """Declare a number, by default from 0 to a million."""
    return Parameter(name, "float", default, meaning, unit, minimum=minimum, maximum=maximum, symbol=symbol)


def _positive(
    name: str, default: float | None, meaning: str, unit: str = "", maximum: float | None = None, symbol: str = ""
) -> Parameter:
    return Parameter(name, "float", default, meaning, unit, above=0.0, maximum=maximum, symbol=symbol)


def _vector(name: str, default: Vector, meaning: str, unit: str, largest: float) -> Parameter:
    return Parameter(name, "vector", default, meaning, unit, minimum=-largest, maximum=largest)


MAGNITUDE = ("mag", -5.0, 30.0)
"""Unit and bounds of a magnitude."""

PARAMETERS = (
    # step A: the reference catalogue
    _choice("catalogue", "synthetic", "reference catalogue (step A)", CATALOGUES),
    Parameter(
        "n_obj",
        "int",
        None,
        "number of objects; default: all quasars or rows brighter than v_max, 116 galaxies, 11 radio stars",
        minimum=2,
        maximum=10_000_000,
        symbol=r"$N_\mathrm{obj}$",
    ),
    _number(
        "v_max",
        None,
        "limiting magnitude V; default: synthetic 15, quasars 20, galaxies 13.5, else none",
        *MAGNITUDE,
        r"$V_\mathrm{max}$",
    ),
    _number("v_min", None, "brightest magnitude V; default: synthetic 5, else none", *MAGNITUDE, r"$V_\mathrm{min}$"),
    _choice(
        "counts",
        "catalogue",
        "number of quasars: of the paper's catalogue, or completed to the full sky",
        ("catalogue", "completed"),
    ),
    _number(
        "mean_pm",
        0.0,
        "mean modulus of the proper motions, synthetic catalogue",
        "mas / yr",
        maximum=None,
        symbol=r"$\overline{\mu}$",
    ),
    _choice(
        "pm_distribution", "uniform", "distribution of that modulus about its mean", ("uniform", "constant", "rayleigh")
    ),
    _choice(
        "positions",
        None,
        "radio stars, file: own positions or random ones; default: radio stars random, file own",
        ("own", "isotropic"),
    ),
    _number(
        "zone_of_avoidance",
        0.0,
        "no random positions at Galactic latitudes |b| below this",
        "deg",
        0.0,
        89.0,
        r"$|b|_\mathrm{min}$",
    ),
    _number(
        "sky_contrast",
        0.0,
        "(north - south)/(north + south) of the numbers on both sides of the Galactic plane, random positions",
        minimum=-0.99,
        maximum=0.99,
    ),
    Parameter("file", "file", None, "table of objects for catalogue = 'file' (Gaia column names by default)"),
    Parameter("columns", "map", (), "names of the table's columns where they are not Gaia's"),
    Parameter(
        "units", "map", (), "units of quantities whose columns have none: ra = 'hourangle'; default: Gaia's units"
    ),
    Parameter(
        "pmra_cos_dec",
        "bool",
        None,
        "whether pmra of the file includes cos(dec) (its error always does); needed unless the file is Gaia's",
    ),
    # steps C and D: errors
    _choice("satellite_errors", "magnitude", "error model of the satellite (step D)", error_kinds("satellite")),
    _choice("reference_errors", "none", "error model of the reference (step C)", error_kinds("reference")),
    Parameter(
        "model",
        "str",
        "amex",
        "mission whose accuracy curve gives the 'magnitude' errors",
        choices=tuple(MISSIONS),
        define=mission_from_table,
    ),
    _positive("mission_length", None, "mission length; default: the model's own (amex 2, gaia 5)", "yr", symbol="$T$"),
    *(
        _number(f"{side}_sigma_{key}", 1.0, f"{side} {what} error, 'normal' errors", unit, maximum=None)
        for side in ("satellite", "reference")
        for key, what, unit in (("pos", "position", "mas"), ("pm", "proper-motion", "mas / yr"))
    ),
    _number("error_scale", 1.0, "factor on all errors"),
    _number("satellite_error_scale", 1.0, "further factor on the satellite's errors", symbol=r"$\Delta_\mathrm{sat}$"),
    _number("reference_error_scale", 1.0, "further factor on the reference's errors", symbol=r"$\Delta_\mathrm{ref}$"),
    # the truth (step B)
    _vector("epsilon", (1.0, 1.0, 1.0), "true orientation, reference - satellite", "mas", 1e8),
    _vector("omega", (1.0, 1.0, 1.0), "true spin, reference - satellite", "mas / yr", 1e8),
    _number(
        "epsilon_size", None, "length of epsilon, which then gives the direction only", "mas", 0.0, 1e8, r"$|\epsilon|$"
    ),
    _number(
        "omega_size", None, "length of omega, which then gives the direction only", "mas / yr", 0.0, 1e8, r"$|\omega|$"
    ),
    _choice(
        "directions",
        "fixed",
        "directions of epsilon and omega: as given, or random for each catalogue",
        ("fixed", "random"),
    ),
    Parameter("aberration", "bool", False, "add a glide to the satellite's proper motions (Galactic aberration)"),
    Parameter(
        "glide", "vector", None, "glide added by aberration; default: 4 uas/yr towards the Galactic centre", "uas / yr"
    ),
    # systematics
    _number(
        "satellite_floor_pos",
        0.0,
        "noise floor in the satellite's position errors, added in quadrature after all scales",
        "mas",
    ),
    _number("satellite_floor_pm", 0.0, "noise floor in the satellite's proper-motion errors", "mas / yr"),
    _number("reference_floor_pos", 0.0, "noise floor in the reference's position errors", "mas"),
    _number("reference_floor_pm", 0.0, "noise floor in the reference's proper-motion errors", "mas / yr"),
    _positive(
        "satellite_error_ratio",
        1.0,
        "true errors of the satellite over those in the weights: 2 where they are underestimated by a factor 2",
        maximum=100.0,
    ),
    _positive("reference_error_ratio", 1.0, "true errors of the reference over those in the weights", maximum=100.0),
    _number(
        "zonal_pos",
        0.0,
        "RMS per coordinate of satellite position errors that neighbours on the sky share, not in the weights",
        "mas",
    ),
    _number("zonal_pm", 0.0, "RMS per coordinate of such errors of the satellite's proper motions", "mas / yr"),
    _number(
        "zonal_length",
        30.0,
        "width of the Gaussian correlation of zonal errors over angular distance",
        "deg",
        6.0,
        180.0,
    ),
    _vector(
        "omega_slope",
        (0.0, 0.0, 0.0),
        "change of the true spin with magnitude: omega + omega_slope (V - v_zero)",
        "mas / (yr mag)",
        1e6,
    ),
    _number("omega_slope_size", None, "length of omega_slope, which then gives the direction only", "mas / (yr mag)"),
    *(
        _number(
            f"magnitude_equation_{motion}",
            0.0,
            f"error of the satellite's {motion} for each magnitude that an object is fainter than v_zero",
            "mas / (yr mag)",
            -1e6,
        )
        for motion in ("pmra", "pmdec")
    ),
    _number("v_zero", 15.0, "magnitude at which omega is the spin and a magnitude equation is zero", *MAGNITUDE),
    Parameter(
        "motion_field",
        "str",
        None,
        "vector spherical harmonics in the satellite's proper motions, as 't_2_0=0.1,s_2_1_re=-0.2' in mas/yr",
    ),
    _number(
        "motion_field_size",
        None,
        "RMS length over the sky of motion_field, which then gives the pattern only",
        "mas / yr",
    ),
    # step E: the solution
    Parameter("solve_glide", "bool", False, "solve for a glide too"),
    Parameter("corrections", "bool", True, "keep the A21 terms in the design matrix"),
    _choice(
        "weighting",
        "inverse-variance",
        "weights of the solution: 1/(sigma_ref^2 + sigma_sat^2), or all equal",
        ("inverse-variance", "equal"),
    ),
    _choice(
        "arithmetic",
        "exact",
        "differences of catalogues: exact, or by subtracting stored angles as in the paper",
        ("exact", "stored"),
    ),
    _choice(
        "method",
        "catalogue",
        "what is drawn: the errors of every object, or (projected) their effect on the link, at a cost without n_obj",
        ("catalogue", "projected"),
    ),
)

SHARED = (
    # These change what is computed from the normals: gains, weights and units of the errors.
    *("model", "mission_length", "error_scale", "satellite_error_scale", "reference_error_scale"),
    *("satellite_sigma_pos", "satellite_sigma_pm", "reference_sigma_pos", "reference_sigma_pm"),
    *("corrections", "weighting", "solve_glide", "arithmetic"),
    # Each side draws its normals from its own stream, so a side without errors does not change those of the other.
    *("satellite_errors", "reference_errors"),
    # The truth draws only its directions, from another stream than the catalogue.
    *("epsilon", "omega", "epsilon_size", "omega_size", "directions", "aberration", "glide"),
    *("omega_slope", "omega_slope_size", "magnitude_equation_pmra", "magnitude_equation_pmdec", "v_zero"),
    *("motion_field", "motion_field_size"),
    *("satellite_floor_pos", "satellite_floor_pm", "reference_floor_pos", "reference_floor_pm"),
    *("satellite_error_ratio", "reference_error_ratio"),
    # Zonal errors have their own stream; those of a wider kernel use its first numbers.
    *("zonal_pos", "zonal_pm", "zonal_length"),
    # The same uniform numbers become other positions, magnitudes or motions of the same objects.
    *("v_min", "mean_pm", "pm_distribution", "zone_of_avoidance", "sky_contrast"),
    # Quasars to a brighter limit (at half magnitudes) are the first of those to a fainter one; in other catalogues only
    # magnitudes change, and a file gives some of the same rows.
    "v_max",
    # Not shared: catalogue, n_obj, counts, positions, file, columns, units, pmra_cos_dec, which make other objects from
    # the same numbers, so that nothing is left to compare; and method, which draws other numbers.
)
"""Parameters whose values do not change the random numbers of a block, only what is computed from them."""
