"""The conclusion of a study with its values filled in, from its results."""

import math
from contextlib import suppress
from string import Formatter

import xarray as xr

from sweep.analysis.measured_claims import OutsideGridError, in_words, measure, unit_of
from sweep.analysis.verdicts import ARITHMETIC, MC_ERRORS_ALLOWED, Measured
from sweep.contract import SweepError
from sweep.readable import in_short, with_unit
from sweep.studies.form import Conclusion, ConclusionValue, Reading

CONCLUSION = "conclusion"
"""The attribute of a dataset that holds it, as JSON."""

PLUS_MINUS = " ± "
"""Between two values of a sentence: the second is the error of the first."""


def conclusion_in_words(dataset: xr.Dataset) -> list[str]:
    """Return the sentences of the study's conclusion that this grid can fill, with the numbers of its results.

    A number that is not known yet is ``[not done yet]``.  A sentence whose condition is not met is not said; another
    says so instead, and another again where the error of a number with a condition is not known.  Sentences about
    points that this grid does not have are left out.  Raises SweepError for a conclusion that cannot be read.
    """
    if CONCLUSION not in dataset.attrs:
        return []
    try:
        conclusion = Conclusion.model_validate_json(dataset.attrs[CONCLUSION])
    except (ValueError, TypeError) as error:
        raise SweepError(f"the attribute {CONCLUSION!r} cannot be read: {error}") from error
    sentences = []
    for sentence in conclusion.sentences:
        with suppress(OutsideGridError):
            sentences.append(_filled(dataset, conclusion, sentence))
    return sentences


def _filled(dataset: xr.Dataset, conclusion: Conclusion, sentence: str) -> str:
    pieces: list[str] = []
    unmet: list[str] = []
    unjudged: list[str] = []
    before: tuple[Measured, str] | None = None
    for text, name, form, _ in Formatter().parse(sentence):
        pieces.append(text)
        if name is None:
            continue
        value = conclusion.values[name]
        measured = _measured(dataset, value)
        quantity = value.quantity()
        unit = unit_of(dataset, quantity) if isinstance(quantity, Reading) else ""
        if before is not None and text == PLUS_MINUS and not form and _is_error_of(before, measured, unit):
            pieces[-2:] = [with_unit(before[0].value, measured.value, unit)]
        else:
            pieces.append(_number(measured, unit, form or ""))
        before = None if form else (measured, unit)
        if measured.missing or not value.has_bounds:
            continue
        if not measured.broken and not math.isfinite(measured.error):
            unjudged.append(in_words(quantity))
        elif bound := _broken_bound(value, measured):
            unmet.append(f"{in_words(quantity)} is {in_short(measured.value, measured.error, unit)}, not {bound}")
    text = "".join(pieces)
    if unmet:
        return f"Expected, but not found: “{text}” ({'; '.join(dict.fromkeys(unmet))})."
    if unjudged:
        return f"Not judged: “{text}” (the error of {', '.join(dict.fromkeys(unjudged))} is not known)."
    return text


def _is_error_of(value: tuple[Measured, str], error: Measured, unit: str) -> bool:
    """Return whether two numbers can be written as one with its error: both are known, and in one unit."""
    whole = (value[0], error)
    return value[1] == unit and not any(one.missing or one.broken for one in whole) and error.value > 0.0


def _measured(dataset: xr.Dataset, value: ConclusionValue) -> Measured:
    """Return the one number that a value stands for; raises OutsideGridError where this grid does not have it."""
    places = measure(dataset, value, value.quantity())
    measured = [one for one in places if value.choose is None or not one.missing.startswith("excluded")]
    if not measured:
        return Measured({}, missing="not done yet")
    if missing := [one for one in measured if one.missing or not math.isfinite(one.value)]:
        return missing[0] if missing[0].missing else Measured({}, missing="not a finite number")
    pick = max if value.choose == "largest" else min
    return pick(measured, key=lambda one: one.value)


def _number(measured: Measured, unit: str, form: str) -> str:
    if measured.missing:
        return f"[{measured.missing.partition(':')[0]}]"
    if measured.broken:
        return f"[{measured.broken}]"
    if form == "%":
        return f"{in_short(100.0 * measured.value, 100.0 * measured.error)} %"
    if form == "error":
        return with_unit(measured.value, measured.error, unit)
    return in_short(measured.value, measured.error, unit)


def _broken_bound(value: ConclusionValue, measured: Measured) -> str:
    """Return which bound a number does not keep, in words; '' where it keeps both."""
    number = measured.value
    allowed = MC_ERRORS_ALLOWED * measured.error + ARITHMETIC * abs(number)
    if value.above is not None and not number + allowed > value.above:
        return f"above {value.above:g}"
    if value.below is not None and not number - allowed < value.below:
        return f"below {value.below:g}"
    if value.equals is not None and not abs(number - value.equals) <= allowed:
        return f"{value.equals:g} within {MC_ERRORS_ALLOWED:g} of its errors"
    return ""
