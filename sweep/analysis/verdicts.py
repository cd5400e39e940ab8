"""The verdict on one published number, and which deviation it would have found."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from sweep.readable import prefixed

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete"]
VERDICTS: tuple[Verdict, ...] = ("reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete")

MC_ERRORS_ALLOWED = 3.0
PROBABILITY, FOUND = 0.95, 1.6449
"""A deviation is found with this probability if it is so many Monte-Carlo errors beyond what is allowed."""

MOST_UNSEEN = 1.0 / 3.0
"""A verdict that would miss a deviation of more than this, relative to the published number, is none."""

ARITHMETIC = 1e-9
"""Relative difference that is no difference: 0.605 - 0.6 in binary is a little more than 0.005."""


@dataclass(frozen=True)
class Comparison:
    """One published number beside ours, in ``unit``; ``where`` is its place on the axes.

    ``what`` is the name of the output or the words of the claim, ``quantity`` how it is derived; ``mc_error`` is one
    sigma of ``value`` (0 where there is none, NaN where it is not known), ``difference`` value - published,
    ``allowance`` what of it rounding and Monte-Carlo error explain.  ``detectable`` is the smallest deviation of the
    true value from the published one that the verdict finds with a probability of 95 %, ``power`` that over the
    published number.  What is not there is NaN, and ``reason`` says why; a tolerance that was needed has its reason
    there.
    """

    study: str
    what: str
    quantity: str
    where: Mapping[str, Any]
    unit: str
    value: float
    mc_error: float
    published: float
    rounding: float
    allowance: float
    difference: float
    detectable: float
    power: float
    verdict: Verdict
    source: str
    reason: str = ""


def in_readable_unit(comparison: Comparison) -> Comparison:
    """Return a comparison with its numbers in the unit in which the published one reads best."""
    chosen = prefixed(comparison.published, comparison.unit)
    if chosen.factor == 1.0:
        return comparison
    numbers = ("value", "mc_error", "published", "rounding", "allowance", "difference", "detectable")
    scaled = {name: chosen.factor * getattr(comparison, name) for name in numbers}
    return replace(comparison, unit=chosen.unit, **scaled)


@dataclass(frozen=True)
class PublishedNumber:
    """One number that was published, with its ``rounding`` and its relative ``tolerance``.

    ``null`` is what there would be without the effect that the number shows: a verdict must tell the two apart.
    ``not_comparable`` says why there can be no verdict.
    """

    number: float
    rounding: float
    source: str
    tolerance: float = 0.0
    reason: str = ""
    null: float | None = None
    not_comparable: str = ""

    @property
    def most_unseen(self) -> float:
        """Return the deviation that a verdict must find."""
        limits = [MOST_UNSEEN * abs(self.number)] if self.number else []
        if self.null is not None:
            limits.append(abs(self.number - self.null))
        return min(limits, default=math.inf)


@dataclass(frozen=True)
class Measured:
    """Our number at one place, or why there is none: ``missing`` if it was not computed, ``broken`` if it cannot be."""

    where: Mapping[str, Any]
    value: float = math.nan
    error: float = 0.0
    missing: str = ""
    broken: str = ""


def judged(study: str, what: str, quantity: str, unit: str, ours: Measured, published: PublishedNumber) -> Comparison:
    """Return the comparison of our number with the published one."""
    allowance = published.rounding + MC_ERRORS_ALLOWED * ours.error
    tolerance = published.tolerance * abs(published.number)
    is_found = math.isfinite(ours.value) and not published.not_comparable
    detectable = allowance + tolerance + FOUND * ours.error if is_found else math.nan
    verdict, reason = _verdict(ours, published, allowance, tolerance)
    return Comparison(
        study=study,
        what=what,
        quantity=quantity,
        where=ours.where,
        unit=unit,
        value=ours.value,
        mc_error=ours.error,
        published=published.number,
        rounding=published.rounding,
        allowance=allowance,
        difference=ours.value - published.number,
        detectable=detectable,
        power=detectable / abs(published.number) if published.number else math.nan,
        verdict=verdict,
        source=published.source,
        reason=reason,
    )


def _verdict(ours: Measured, published: PublishedNumber, allowance: float, tolerance: float) -> tuple[Verdict, str]:
    if ours.missing:
        return "incomplete", ours.missing
    if ours.broken or not math.isfinite(ours.value):
        return "NOT reproduced", ours.broken or "the result is not a finite number"
    if published.not_comparable:
        return "not comparable", published.not_comparable
    if not math.isfinite(ours.error):
        return "incomplete", "the error of our number is not known (docs/errors.md)"
    return _verdict_on_numbers(ours, published, allowance, tolerance)


def _verdict_on_numbers(
    ours: Measured, published: PublishedNumber, allowance: float, tolerance: float
) -> tuple[Verdict, str]:
    """Return a verdict where both numbers have what it takes: one that passes must have been able to fail."""
    off = abs(ours.value - published.number) - ARITHMETIC * abs(published.number)
    most = published.most_unseen
    apart = f"more than {most:.3g}, which it must find"
    if off > allowance + tolerance:
        return "NOT reproduced", ""
    if (passes := published.rounding + tolerance) > most:
        return "not comparable", f"rounding and tolerance let pass a deviation of {passes:.3g}, {apart}"
    if (passes := allowance + tolerance + FOUND * ours.error) > most:
        needed = "more realisations or catalogues are needed"
        return "incomplete", f"our Monte-Carlo error lets pass a deviation of {passes:.3g}, {apart}: {needed}"
    if off <= allowance:
        return "reproduced", ""
    return "within tolerance", f"{100.0 * published.tolerance:g} %: {published.reason}"
