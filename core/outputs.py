"""The outputs of a study of the link: names, units and meanings, nothing else."""

from linksweep.sweep.contract import Output

UNITS = ("mas",) * 3 + ("mas / yr",) * 3
# No slashes: astropy warns about several in one string.
_EACH = "mas, mas, mas, mas yr-1, mas yr-1, mas yr-1"
_TOP = "(mas2, mas2, mas2, mas2 yr-1, mas2 yr-1, mas2 yr-1)"
_BOTTOM = "(mas2 yr-1, mas2 yr-1, mas2 yr-1, mas2 yr-2, mas2 yr-2, mas2 yr-2)"
_PRODUCTS = ", ".join([_TOP] * 3 + [_BOTTOM] * 3)
_COMPONENT, _PAIR, _OF_GLIDE = ("component",), ("component", "component_other"), ("glide_component",)


def _with_errors(
    name: str, unit: str, meaning: str, dims: tuple[str, ...] = (), headline: bool = False, symbol: str = ""
) -> list[Output]:
    prediction = f"closed-form prediction of {name} for the same catalogues"
    beside = {
        "mc_error": f"Monte-Carlo error of {name}, sigma/sqrt(2 n)",
        "predicted": f"{prediction}, from the errors alone, without the bias",
        "rms_predicted": f"{prediction}, from errors and bias together",
        "catalogue_error": f"error of {name} as the mean over all possible catalogues, because only n_cat were drawn; "
        "NaN below 5",
    }
    return [
        Output(name, unit, meaning, dims, headline, symbol, nan=True),
        *(Output(f"{name}_{key}", unit, text, dims, nan=True) for key, text in beside.items()),
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
    *_with_errors("sigma", _EACH, "RMS of estimate - truth", _COMPONENT),
    Output("bias", _EACH, "mean of estimate - truth", _COMPONENT, nan=True),
    Output(
        "bias_predicted",
        _EACH,
        "closed-form prediction of bias for the same catalogues: the effect of aberration or of terms left out",
        _COMPONENT,
        nan=True,
    ),
    Output(
        "bias_mc_error",
        _EACH,
        "Monte-Carlo error of bias, from the scatter of catalogues, or of realisations of a single one; NaN for 2 to 4",
        _COMPONENT,
        nan=True,
    ),
    Output("covariance", _PRODUCTS, "covariance of the estimates about their mean", _PAIR, nan=True),
    Output("correlation", "", "correlation of the estimates about their mean", _PAIR, nan=True),
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
    Output("glide_sigma", "mas / yr", "RMS of estimate - truth of a glide that was solved for", _OF_GLIDE, nan=True),
    Output("glide_bias", "mas / yr", "mean of estimate - truth of a glide that was solved for", _OF_GLIDE, nan=True),
)

SAMPLE_OUTPUTS = (
    Output("estimate", _EACH, "estimate of each realisation, where a study keeps them", _COMPONENT, nan=True),
)
