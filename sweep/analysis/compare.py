"""Comparison with published numbers: a verdict on every published number and every claim of a dataset.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.measured_claims import (
    Measured,
    OutsideGridError,
    Points,
    claims_of,
    in_words,
    measure,
    unit_of,
)
from linksweep.sweep.analysis.quantity import OLD_ERRORS, has_old_errors, standard_error, unknown_parts
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import prefixed, units_of
from linksweep.sweep.studies.study import printed_rounding

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete"]
VERDICTS: tuple[Verdict, ...] = ("reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete")

MC_ERRORS_ALLOWED = 3.0
PROBABILITY, FOUND = 0.95, 1.6449
"""Probability of finding a deviation that is ``FOUND`` Monte-Carlo errors larger than what is allowed."""

MOST_UNSEEN = 1.0 / 3.0
"""No verdict is given that would miss a deviation larger than this, relative to the published number."""

ARITHMETIC = 1e-9
"""Smaller relative differences come from the arithmetic: 0.605 - 0.6 in binary is a little more than 0.005."""


@dataclass(frozen=True)
class Comparison:
    """One published number beside ours, in ``unit``; ``where`` is its place on the axes.

    ``what`` is the name of the output or the words of the claim, ``quantity`` how it is derived; ``mc_error`` is one
    sigma of ``value`` (0 where there is none, NaN where it is not known), ``difference`` value - published,
    ``allowance`` the part of it that rounding and Monte-Carlo error explain.  ``detectable`` is the smallest deviation
    of the true value from the published one that the verdict finds with a probability of 95 %, ``power`` the same
    relative to the published number.  Missing numbers are NaN, and ``reason`` says why; it also gives the reason for a
    tolerance that was needed.
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

    ``null`` is the value expected without the effect that the number shows: a verdict must tell the two apart.
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
        """Return the smallest deviation that a verdict must find."""
        limits = [MOST_UNSEEN * abs(self.number)] if self.number else []
        if self.null is not None:
            limits.append(abs(self.number - self.null))
        return min(limits, default=math.inf)


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
    """Return the verdict on two known numbers: they agree only if a disagreement would have been found."""
    off = abs(ours.value - published.number) - ARITHMETIC * abs(published.number)
    most = published.most_unseen
    apart = f"more than {most:.3g}, which the verdict must find"
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


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def remarks(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what was changed in the study, and those of `caveats`."""
    overrides = dataset.attrs.get("study_overrides")
    changed = [f"the study was changed on the command line: {overrides}"] if overrides else []
    return [*changed, *caveats(dataset)]


def caveats(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what a comparison of this dataset leaves out, and about what affects its meaning."""
    sentences = []
    if has_old_errors(dataset):
        sentences.append(OLD_ERRORS)
    compared = [str(name).removesuffix("_published") for name in dataset.data_vars if str(name).endswith("_published")]
    compared += [claim.quantity().variable for claim in claims_of(dataset)]
    for output in dict.fromkeys(compared):
        sentences += unknown_parts(dataset, output)
    for name, variable in dataset.data_vars.items():
        if outside := int(variable.attrs.get("outside_grid", 0)):
            numbers = "1 published number is" if outside == 1 else f"{outside} published numbers are"
            sentences.append(f"{str(name).removesuffix('_published')}: {numbers} not in this grid and not compared")
    return sentences


def summary(comparisons: Sequence[Comparison]) -> dict[Verdict, int]:
    """Return how many comparisons have each verdict."""
    counts = Counter(c.verdict for c in comparisons)
    return {verdict: counts[verdict] for verdict in VERDICTS}


def all_is_well(comparisons: Sequence[Comparison]) -> bool:
    """Return whether everything that is comparable is reproduced or within tolerance."""
    return all(c.verdict in ("reproduced", "within tolerance", "not comparable") for c in comparisons)


def _published_numbers(dataset: xr.Dataset) -> Iterator[Comparison]:
    """Yield the comparisons of NAME with NAME_published, point by point."""
    study = str(dataset.attrs.get("study_name", ""))
    for name in map(str, dataset.data_vars):
        table = f"{name}_published"
        if table not in dataset:
            continue
        unit = units_of(dataset[name].attrs)
        points = Points.of(dataset, name)
        for index in np.argwhere(np.isfinite(dataset[table].values)):
            here = dict(zip(map(str, dataset[table].dims), map(int, index), strict=True))
            yield judged(study, name, name, unit, points.at(here), _printed(dataset, name, here))


def _printed(dataset: xr.Dataset, name: str, here: Mapping[str, int]) -> PublishedNumber:
    published = dataset[f"{name}_published"]
    if f"{name}_published_rounding" not in dataset:
        raise SweepError("was written by an earlier version; `sweep run` the study again (nothing is computed anew)")
    number, attributes = float(published[here]), published.attrs
    rounding = float(dataset[f"{name}_published_rounding"][here])
    source, reason = str(attributes["source"]), str(attributes.get("tolerance_reason", ""))
    if rounding == 0.5 and number.is_integer() and standard_error(dataset, name) is None:
        return PublishedNumber(number, 0.0, source)  # a count, which is exact
    return PublishedNumber(number, rounding, source, float(attributes.get("tolerance", 0.0)), reason)


def _claims(dataset: xr.Dataset) -> Iterator[Comparison]:
    study = str(dataset.attrs.get("study_name", ""))
    for claim in claims_of(dataset):
        quantity = claim.quantity()
        published = PublishedNumber(
            number=float(claim.published),
            rounding=0.0 if claim.exact else printed_rounding(claim.published),
            source=claim.source,
            tolerance=claim.tolerance or 0.0,
            reason=claim.tolerance_reason or "",
            null=claim.null,
            not_comparable=claim.not_comparable or "",
        )
        try:
            measured = list(measure(dataset, claim, quantity))
        except OutsideGridError as error:
            measured = [Measured(claim.where, missing=str(error))]
        for one in measured:
            yield judged(study, claim.text, in_words(quantity), unit_of(dataset, quantity), one, published)
