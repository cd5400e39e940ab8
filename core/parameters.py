"""What a study of the link can set, and what comes out: names, units, defaults and meanings, nothing else."""

from core.catalogues import CATALOGUES
from core.errors import error_kinds
from core.missions import MISSIONS
from core.user_mission import mission_from_table
from sweep.contract import Output, Parameter

PARAMETERS = (
    # step A: the reference catalogue
    Parameter(
        "catalogue",
        "str",
        "synthetic",
        "reference catalogue (step A)",
        choices=tuple(CATALOGUES),
    ),
    Parameter(
        "n_obj",
        "int",
        None,
        "number of objects; default: all quasars or rows brighter than v_max, 116 galaxies, 11 radio stars",
        minimum=2,
        maximum=10_000_000,
        symbol=r"$N_\mathrm{obj}$",
    ),
    Parameter(
        "v_max",
        "float",
        None,
        "limiting magnitude V; default: synthetic 15, quasars 20, galaxies 13.5, else none",
        unit="mag",
        minimum=-5.0,
        maximum=30.0,
        symbol=r"$V_\mathrm{max}$",
    ),
    Parameter(
        "v_min",
        "float",
        None,
        "brightest magnitude V; default: synthetic 5, else none",
        unit="mag",
        minimum=-5.0,
        maximum=30.0,
        symbol=r"$V_\mathrm{min}$",
    ),
    Parameter(
        "counts",
        "str",
        "catalogue",
        "number of quasars: of the paper's catalogue, or completed to the full sky",
        choices=("catalogue", "completed"),
    ),
    Parameter(
        "mean_pm",
        "float",
        0.0,
        "mean modulus of the proper motions, synthetic catalogue",
        unit="mas / yr",
        minimum=0.0,
        symbol=r"$\overline{\mu}$",
    ),
    Parameter(
        "pm_distribution",
        "str",
        "uniform",
        "distribution of that modulus about its mean",
        choices=("uniform", "constant", "rayleigh"),
    ),
    Parameter(
        "positions",
        "str",
        None,
        "radio stars, file: own positions or random ones; default: radio stars random, file own",
        choices=("own", "isotropic"),
    ),
    Parameter(
        "zone_of_avoidance",
        "float",
        0.0,
        "no random positions at Galactic latitudes |b| below this",
        unit="deg",
        minimum=0.0,
        maximum=89.0,
        symbol=r"$|b|_\mathrm{min}$",
    ),
    Parameter(
        "sky_contrast",
        "float",
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
    Parameter(
        "satellite_errors",
        "str",
        "magnitude",
        "error model of the satellite (step D)",
        choices=error_kinds("satellite"),
    ),
    Parameter(
        "reference_errors",
        "str",
        "none",
        "error model of the reference (step C)",
        choices=error_kinds("reference"),
    ),
    Parameter(
        "model",
        "str",
        "amex",
        "mission whose accuracy curve gives the 'magnitude' errors",
        choices=tuple(MISSIONS),
        define=mission_from_table,
    ),
    Parameter(
        "mission_length",
        "float",
        None,
        "mission length; default: the model's own (amex 2, gaia 5)",
        unit="yr",
        above=0.0,
        symbol="$T$",
    ),
    Parameter(
        "satellite_sigma_pos", "float", 1.0, "satellite position error, 'normal' errors", unit="mas", minimum=0.0
    ),
    Parameter(
        "satellite_sigma_pm",
        "float",
        1.0,
        "satellite proper-motion error, 'normal' errors",
        unit="mas / yr",
        minimum=0.0,
    ),
    Parameter(
        "reference_sigma_pos", "float", 1.0, "reference position error, 'normal' errors", unit="mas", minimum=0.0
    ),
    Parameter(
        "reference_sigma_pm",
        "float",
        1.0,
        "reference proper-motion error, 'normal' errors",
        unit="mas / yr",
        minimum=0.0,
    ),
    Parameter("error_scale", "float", 1.0, "factor on all errors", minimum=0.0, maximum=1e6),
    Parameter(
        "satellite_error_scale",
        "float",
        1.0,
        "further factor on the satellite's errors",
        minimum=0.0,
        maximum=1e6,
        symbol=r"$\Delta_\mathrm{sat}$",
    ),
    Parameter(
        "reference_error_scale",
        "float",
        1.0,
        "further factor on the reference's errors",
        minimum=0.0,
        maximum=1e6,
        symbol=r"$\Delta_\mathrm{ref}$",
    ),
    # the truth (step B)
    Parameter(
        "epsilon",
        "vector",
        (1.0, 1.0, 1.0),
        "true orientation, reference - satellite",
        unit="mas",
        minimum=-1e8,
        maximum=1e8,
    ),
    Parameter(
        "omega",
        "vector",
        (1.0, 1.0, 1.0),
        "true spin, reference - satellite",
        unit="mas / yr",
        minimum=-1e8,
        maximum=1e8,
    ),
    Parameter(
        "epsilon_size",
        "float",
        None,
        "length of epsilon, which then gives the direction only",
        unit="mas",
        minimum=0.0,
        maximum=1e8,
        symbol=r"$|\epsilon|$",
    ),
    Parameter(
        "omega_size",
        "float",
        None,
        "length of omega, which then gives the direction only",
        unit="mas / yr",
        minimum=0.0,
        maximum=1e8,
        symbol=r"$|\omega|$",
    ),
    Parameter(
        "directions",
        "str",
        "fixed",
        "directions of epsilon and omega: as given, or random for each catalogue",
        choices=("fixed", "random"),
    ),
    Parameter("aberration", "bool", False, "add a glide to the satellite's proper motions (Galactic aberration)"),
    Parameter("glide", "vector", None, "that glide; default: 4 uas/yr towards the Galactic centre", unit="uas / yr"),
    # systematics
    Parameter(
        "satellite_floor_pos",
        "float",
        0.0,
        "noise floor in the satellite's position errors, in quadrature and after all scales",
        unit="mas",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "satellite_floor_pm",
        "float",
        0.0,
        "noise floor in the satellite's proper-motion errors",
        unit="mas / yr",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "reference_floor_pos",
        "float",
        0.0,
        "noise floor in the reference's position errors",
        unit="mas",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "reference_floor_pm",
        "float",
        0.0,
        "noise floor in the reference's proper-motion errors",
        unit="mas / yr",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "satellite_error_ratio",
        "float",
        1.0,
        "true errors of the satellite over those that weigh: 2 where they are underestimated by a factor 2",
        above=0.0,
        maximum=100.0,
    ),
    Parameter(
        "reference_error_ratio",
        "float",
        1.0,
        "true errors of the reference over those that weigh",
        above=0.0,
        maximum=100.0,
    ),
    Parameter(
        "zonal_pos",
        "float",
        0.0,
        "RMS per coordinate of errors of the satellite's positions that neighbours on the sky share; they do not weigh",
        unit="mas",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "zonal_pm",
        "float",
        0.0,
        "RMS per coordinate of such errors of the satellite's proper motions",
        unit="mas / yr",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "zonal_length",
        "float",
        30.0,
        "width of the Gaussian by which zonal errors are correlated over angular distance",
        unit="deg",
        minimum=6.0,
        maximum=180.0,
    ),
    Parameter(
        "omega_slope",
        "vector",
        (0.0, 0.0, 0.0),
        "change of the true spin with magnitude: omega + omega_slope (V - v_zero)",
        unit="mas / (yr mag)",
        minimum=-1e6,
        maximum=1e6,
    ),
    Parameter(
        "omega_slope_size",
        "float",
        None,
        "length of omega_slope, which then gives the direction only",
        unit="mas / (yr mag)",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "magnitude_equation_pmra",
        "float",
        0.0,
        "error of the satellite's pmra for each magnitude that an object is fainter than v_zero",
        unit="mas / (yr mag)",
        minimum=-1e6,
        maximum=1e6,
    ),
    Parameter(
        "magnitude_equation_pmdec",
        "float",
        0.0,
        "error of the satellite's pmdec for each magnitude that an object is fainter than v_zero",
        unit="mas / (yr mag)",
        minimum=-1e6,
        maximum=1e6,
    ),
    Parameter(
        "v_zero",
        "float",
        15.0,
        "magnitude at which omega is the spin and a magnitude equation is zero",
        unit="mag",
        minimum=-5.0,
        maximum=30.0,
    ),
    Parameter(
        "motion_field",
        "str",
        None,
        "vector spherical harmonics in the satellite's proper motions, as 't_2_0=0.1,s_2_1_re=-0.2' in mas/yr",
    ),
    Parameter(
        "motion_field_size",
        "float",
        None,
        "RMS length over the sky of motion_field, which then gives the pattern only",
        unit="mas / yr",
        minimum=0.0,
        maximum=1e6,
    ),
    # step E: the solution
    Parameter("solve_glide", "bool", False, "solve for a glide too"),
    Parameter("corrections", "bool", True, "keep the A21 terms in the design matrix"),
    Parameter(
        "weighting",
        "str",
        "inverse-variance",
        "weights of the solution: 1/(sigma_ref^2 + sigma_sat^2), or all equal",
        choices=("inverse-variance", "equal"),
    ),
    Parameter(
        "arithmetic",
        "str",
        "exact",
        "differences of catalogues: exact, or by subtracting stored angles as in the paper",
        choices=("exact", "stored"),
    ),
    Parameter(
        "method",
        "str",
        "catalogue",
        "what is drawn: errors of every object, or projected, what the link makes of them, at a cost without n_obj",
        choices=("catalogue", "projected"),
    ),
)

SHARED = (
    # What is made of the normals: gains, weights and units of the errors.
    *("model", "mission_length", "error_scale", "satellite_error_scale", "reference_error_scale"),
    *("satellite_sigma_pos", "satellite_sigma_pm", "reference_sigma_pos", "reference_sigma_pm"),
    *("corrections", "weighting", "solve_glide", "arithmetic"),
    # Each side's normals are a stream of its own, so one side without errors leaves the other's as they are.
    *("satellite_errors", "reference_errors"),
    # The truth draws nothing but its directions, from a stream beside that of the catalogue.
    *("epsilon", "omega", "epsilon_size", "omega_size", "directions", "aberration", "glide"),
    *("omega_slope", "omega_slope_size", "magnitude_equation_pmra", "magnitude_equation_pmdec", "v_zero"),
    *("motion_field", "motion_field_size"),
    *("satellite_floor_pos", "satellite_floor_pm", "reference_floor_pos", "reference_floor_pm"),
    *("satellite_error_ratio", "reference_error_ratio"),
    # Zonal errors are a stream of their own, and those of a wider kernel its beginning.
    *("zonal_pos", "zonal_pm", "zonal_length"),
    # The same uniform numbers become other positions, magnitudes or motions of the same objects.
    *("v_min", "mean_pm", "pm_distribution", "zone_of_avoidance", "sky_contrast"),
    # Quasars of a brighter limit (at half magnitudes) are the first of a fainter one; others only change magnitudes,
    # and a file's are the same rows.
    "v_max",
    # Not: catalogue, n_obj, counts, positions, file, columns, units, pmra_cos_dec, which make other objects of the same
    # numbers, so that nothing is common to compare; and method, which draws others.
)
"""Parameters whose values do not change the random numbers of a block, only what is made of them."""

UNITS = ("mas",) * 3 + ("mas / yr",) * 3
# Without slashes: astropy warns of several in one string.
_EACH = "mas, mas, mas, mas yr-1, mas yr-1, mas yr-1"
_TOP = "(mas2, mas2, mas2, mas2 yr-1, mas2 yr-1, mas2 yr-1)"
_BOTTOM = "(mas2 yr-1, mas2 yr-1, mas2 yr-1, mas2 yr-2, mas2 yr-2, mas2 yr-2)"
_PRODUCTS = ", ".join([_TOP] * 3 + [_BOTTOM] * 3)


def _with_errors(
    name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), headline: bool = False, symbol: str = ""
) -> list[Output]:
    return [
        Output(name, unit, meaning, dims, headline, symbol, nan=True),
        Output(f"{name}_mc_error", unit, f"Monte-Carlo error of {name}, sigma/sqrt(2 n)", dims, nan=True),
        Output(
            f"{name}_predicted",
            unit,
            f"closed-form prediction of {name} for the same catalogues, of the errors alone: without a bias",
            dims,
            nan=True,
        ),
        Output(
            f"{name}_rms_predicted",
            unit,
            f"closed-form prediction of {name} for the same catalogues, errors and bias: all of it",
            dims,
            nan=True,
        ),
        Output(
            f"{name}_catalogue_error",
            unit,
            f"error of {name} as the mean over all possible catalogues, because only n_cat were drawn; NaN below 5",
            dims,
            nan=True,
        ),
    ]


OUTPUTS = (
    Output(
        "n_obj",
        "",
        "number of objects in the catalogue (mean over catalogues)",
        headline=True,
        symbol=r"$N_\mathrm{obj}$",
    ),
    *_with_errors(
        "sigma_spin",
        "mas / yr",
        "RMS error of the spin, over its three components",
        headline=True,
        symbol=r"$\sigma(\omega)$",
    ),
    *_with_errors(
        "sigma_orientation",
        "mas",
        "RMS error of the orientation, over its three components",
        symbol=r"$\sigma(\epsilon)$",
    ),
    *_with_errors("sigma", _EACH, "RMS of estimate - truth", ("component",)),
    Output("bias", _EACH, "mean of estimate - truth", ("component",), nan=True),
    Output(
        "bias_predicted",
        _EACH,
        "closed-form prediction of bias for the same catalogues: what aberration or terms left out make",
        ("component",),
        nan=True,
    ),
    Output(
        "bias_mc_error",
        _EACH,
        "Monte-Carlo error of bias, from the scatter of catalogues, or of realisations of one; NaN for 2 to 4",
        ("component",),
        nan=True,
    ),
    Output(
        "covariance",
        _PRODUCTS,
        "covariance of the estimates about their mean",
        ("component", "component_other"),
        nan=True,
    ),
    Output(
        "correlation",
        "",
        "correlation of the estimates about their mean",
        ("component", "component_other"),
        nan=True,
    ),
    Output(
        "condition_number",
        "",
        "largest over smallest eigenvalue of the normal matrix scaled to a diagonal of 1 (mean over catalogues)",
    ),
    Output(
        "chi2",
        "",
        "mean chi2 of the solution; dof is its expectation for inverse-variance weights of uncorrelated errors",
    ),
    Output("dof", "", "degrees of freedom of chi2 (mean over catalogues)"),
    Output(
        "glide_sigma",
        "mas / yr",
        "RMS of estimate - truth of a glide that was solved for",
        ("glide_component",),
        nan=True,
    ),
    Output(
        "glide_bias",
        "mas / yr",
        "mean of estimate - truth of a glide that was solved for",
        ("glide_component",),
        nan=True,
    ),
)

SAMPLE_OUTPUTS = (
    Output("estimate", _EACH, "estimate of each realisation, where a study keeps them", ("component",), nan=True),
)
