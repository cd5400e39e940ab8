"""The calibration of the mission curves as a report: the paper's tables in, constants and residuals out."""

import csv
import textwrap
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.core import calibration
from linksweep.core.calibration import CONSTANTS, IN_CODE, Fit, Model, PublishedSigma
from linksweep.core.catalogue import N_GALAXIES
from linksweep.core.spin_variance import Kind, Skies
from linksweep.sweep.formatting import WIDTH, reading_table
from linksweep.sweep.readable import in_ascii

if TYPE_CHECKING:
    from rich.console import Group

FORMULA: dict[Model, str] = {
    "amex": "amplitude_bright exp(slope_bright (V-9)) + amplitude_faint exp(slope_faint (V-15))",
    "gaia": "amplitude exp(slope (V-15))",
}


def published_numbers(model: Model) -> dict[str, PublishedSigma]:
    """Return a model's numbers from the paper, as printed, each with a label as key: 28 for amex, 13 for gaia."""
    numbers = {
        f"quasars to V = {row['v_max']}": _number("quasars", int(row["n_obj"]), row["sigma_spin"])
        for row in _rows("table1_quasars.csv")
        if row["model"] == model and row["sigma_spin"]
    }
    if model == "amex":
        for row in _rows("galaxies.csv"):
            numbers[f"{N_GALAXIES} galaxies"] = _number("galaxies", N_GALAXIES, row["sigma_spin"])
        for row in _rows("table2_radio_stars.csv"):
            scale = float(row["reference_error_scale"])
            label = f"{row['n_obj']} radio stars" + ("" if scale == 1.0 else f", VLBI errors x {scale:g}")
            numbers[label] = _number("radio-stars", int(row["n_obj"]), row["sigma_spin"], scale)
    return numbers


def calibration_report(n_cat: int = 200) -> dict[str, Any]:
    """Return both curves' constants, uncertainties and residuals, and the fit with equal weights, as values for JSON.

    ``n_cat`` sets how many catalogues the closed form is averaged over.
    """
    return {
        "model_error": calibration.MODEL_ERROR,
        "paper_mc_error": float(calibration.PAPER_MC_ERROR),
        "curves": {model: _curve_report(model, n_cat) for model in CONSTANTS},
    }


def as_text(report: dict[str, Any]) -> "Group":
    """Return the report as tables for reading."""
    from rich.console import Group

    about = (
        "sigma_mu(V) in mas/yr. Each number is weighted by its rounding error, the paper's Monte-Carlo error of "
        f"{100 * report['paper_mc_error']:.1f} %, that of the catalogues drawn here, "
        f"and {100 * report['model_error']:.0f} % for the model itself. Uncertainties: from the curvature of chi2, "
        "scaled by chi2/dof where that is above one. Equal weights: fitted to the quasars alone."
    )
    curves = (part for model, curve in report["curves"].items() for part in _curve_text(model, curve))
    return Group(textwrap.fill(about, WIDTH), *curves)


def _rows(name: str) -> list[dict[str, str]]:
    text = (resources.files("linksweep") / "sweeps" / "published" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def _number(kind: Kind, n_obj: int, printed: str, reference_error_scale: float = 1.0) -> PublishedSigma:
    decimals = len(printed.partition(".")[2])
    return PublishedSigma(kind, n_obj, float(printed), 0.5 * 10.0**-decimals, reference_error_scale)


def _curve_report(model: Model, n_cat: int) -> dict[str, Any]:
    numbers, skies = published_numbers(model), calibration.all_skies(model, n_cat)
    printed = list(numbers.values())
    found = calibration.fit(model, printed, skies)
    chosen = calibration.constrained(found, printed, skies)
    in_code, _ = calibration.published_model(printed, skies, IN_CODE[model], "inverse-variance")
    rows = _compared(numbers, found.sigma_mas_yr)
    report = {
        "formula": FORMULA[model],
        **_constants(found),
        "chosen": dict(zip(CONSTANTS[model], chosen.tolist(), strict=True)),
        "in_code_chi2": calibration.chi2_of(printed, in_code, found.relative_error),
        "in_code_distance2": found.distance(IN_CODE[model]),
        "numbers": [row | {"in_code": float(code)} for row, code in zip(rows, in_code, strict=True)],
        "equal_weights": _equal_weights(model, numbers, skies),
    }
    if model == "amex":
        at_v = np.array([calibration.DIVA_V_MAG])
        report["independent_check"] = {
            "what": "DIVA's published proper-motion error",
            "v_mag": calibration.DIVA_V_MAG,
            "published": calibration.DIVA_SIGMA_MAS_YR,
            "fitted": float(found.curve(at_v)[0]),
            "in_code": float(IN_CODE[model](at_v)[0]),
        }
    return report


def _constants(found: Fit) -> dict[str, Any]:
    columns = found.constants, found.standard_error, calibration.constants_of(IN_CODE[found.model])
    constants = {
        name: {"unit": "mas / yr" if name.startswith("amplitude") else "1 / mag"}
        | dict(zip(("fitted", "standard_error", "in_code"), map(float, row), strict=True))
        for name, *row in zip(CONSTANTS[found.model], *columns, strict=True)
    }
    return {"constants": constants, "chi2": found.chi2, "dof": found.dof}


def _equal_weights(model: Model, numbers: dict[str, PublishedSigma], skies: dict[Kind, Skies]) -> dict[str, Any]:
    """Fit the quasars alone with equal weights and predict the rest; radio stars also for a satellite without errors,
    which no curve can improve on.
    """
    quasars_only = [number for number in numbers.values() if number.kind == "quasars"]
    found = calibration.fit(model, quasars_only, skies, "equal")
    predicted, _ = calibration.published_model(list(numbers.values()), skies, found.curve, "equal")
    report = {"fitted_to": "quasars", **_constants(found), "numbers": _compared(numbers, predicted)}
    stars = {label: number for label, number in numbers.items() if number.kind == "radio-stars"}
    if stars:
        nothing = calibration.curve_of(model, np.zeros(len(CONSTANTS[model])))
        floor, _ = calibration.published_model(list(stars.values()), skies, nothing, "equal")
        report["perfect_satellite"] = _compared(stars, floor)
    return report


def _compared(numbers: dict[str, PublishedSigma], sigma: Any) -> list[dict[str, Any]]:
    return [
        {
            "what": label,
            "kind": number.kind,
            "n_obj": number.n_obj,
            "reference_error_scale": number.reference_error_scale,
            "published": number.sigma_mas_yr,
            "fitted": float(value),
            "residual": float(value / number.sigma_mas_yr - 1.0),
        }
        for (label, number), value in zip(numbers.items(), sigma, strict=True)
    ]


def _curve_text(model: str, curve: dict[str, Any]) -> list[Any]:
    """Return the tables of a curve, and sentences about them, in lines of 80 characters."""
    equal = curve["equal_weights"]
    constants = []
    for name, row in curve["constants"].items():
        other = equal["constants"][name]
        fitted, alone = (f"{r['fitted']:.4g} ± {r['standard_error']:.2g}" for r in (row, other))
        heading = f"{name} [{in_ascii(row['unit'])}]"
        constants.append([heading, fitted, f"{curve['chosen'][name]:.4g}", f"{row['in_code']:g}", alone])
    chi2 = [f"{c['chi2']:.1f} / {c['dof']}" for c in (curve, equal)]
    constants.append(["chi2 / dof", chi2[0], "", f"{curve['in_code_chi2']:.1f}", chi2[1]])

    floor = {row["what"]: row["residual"] for row in equal.get("perfect_satellite", ())}
    numbers = []
    for row, other in zip(curve["numbers"], equal["numbers"], strict=True):
        residuals = [row["residual"], row["in_code"] / row["published"] - 1.0, other["residual"]]
        residuals += [floor[row["what"]]] if row["what"] in floor else []
        numbers.append([row["what"], f"{row['published']:.2g}", *(f"{100.0 * r:+.1f} %" for r in residuals)])
    last = ["in the\ncode", "equal\nweights"]
    number, perfect = "sigma(omega), residuals", ["perfect\nsat."] if floor else []
    return [
        _lines(f"{model}: {curve['formula']}"),
        reading_table("", ["constant", "fitted", "within\nlimits", *last], constants, left="constant"),
        _lines(_agreement(curve)),
        reading_table("", [number, "published\n[mas/yr]", "fitted", *last, *perfect], numbers, left=number),
        _lines(*_checks(curve)),
    ]


def _lines(*sentences: str) -> str:
    """Return sentences broken into lines, with a blank line before and after."""
    return "\n".join(["", *(textwrap.fill(sentence, WIDTH) for sentence in sentences), ""])


def _agreement(curve: dict[str, Any]) -> str:
    distance, count = curve["in_code_distance2"], len(curve["constants"])
    off = max(abs(row["in_code"] / curve["chosen"][name] - 1.0) for name, row in curve["constants"].items())
    return (
        "In the code are the constants of smallest chi2 with every number within its limit "
        f"({100 * off:.1f} % from those found here). Their squared distance from the free fit is {distance:.1f} in "
        f"units of its covariance, where {count} are expected for {count} constants."
    )


def _checks(curve: dict[str, Any]) -> list[str]:
    sentences = []
    if (check := curve.get("independent_check")) is not None:
        sentences.append(
            f"Independent check, {check['what']} at V = {check['v_mag']:g}: {check['published']:g} published, "
            f"{check['fitted']:.3f} fitted, {check['in_code']:.3f} in the code (mas/yr)."
        )
    equal = curve["equal_weights"]
    numbers = equal["numbers"]
    sentence = f"Equal weights, fitted to the quasars alone: quasars {_range(numbers, 'quasars')}"
    if "perfect_satellite" in equal:
        sentence += (
            f", but galaxies {_range(numbers, 'galaxies')} and radio stars {_range(numbers, 'radio-stars')}. Even a "
            f"satellite without errors would leave the radio stars at "
            f"{_range(equal['perfect_satellite'], 'radio-stars')}: no curve saves this hypothesis."
        )
    else:
        sentence += ": these numbers alone do not tell the two weightings apart."
    return [*sentences, sentence]


def _range(rows: list[dict[str, Any]], kind: str) -> str:
    residuals = [100.0 * row["residual"] for row in rows if row["kind"] == kind]
    low, high = f"{min(residuals):+.0f}", f"{max(residuals):+.0f}"
    return f"{low} %" if low == high else f"{low} to {high} %"
