"""Comparison with published numbers: a verdict on every published number and every claim of a dataset.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.fits import power_law
from linksweep.sweep.analysis.quantity import (
    covariance_along,
    error_of_sum,
    indices,
    place_at,
    place_in_words,
    places_along,
    samples_along,
    standard_error,
    unknown_parts,
)
from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.formatting import finite_or, in_ascii, prefixed, rounded, to_json, units_of, with_error
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import Claim, Derived, Ratio, Reading, Slope, printed_rounding
from linksweep.sweep.table_writer import BOLD, LONG_NAME, Column, Table

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete"]
VERDICTS: Mapping[Verdict, str] = {
    "reproduced": "\x1b[32m",
    "within tolerance": "\x1b[33m",
    "NOT reproduced": "\x1b[1;31m",
    "not comparable": "\x1b[2m",
    "incomplete": "\x1b[33m",
}
"""The verdicts, and their colours on a terminal."""

MC_ERRORS_ALLOWED = 3.0
PROBABILITY, FOUND = 0.95, 1.6449
"""Probability of finding a deviation that is ``FOUND`` Monte-Carlo errors larger than what is allowed."""

MOST_UNSEEN = 1.0 / 3.0
"""No verdict is given that would miss a deviation larger than this, relative to the published number."""

ARITHMETIC = 1e-9
"""Smaller relative differences come from the arithmetic: 0.605 - 0.6 in binary is a little more than 0.005."""

NOT_DONE = "not done yet"
"""Why a number is missing before its points are done."""

CHANCE = f"with a probability of {100 * PROBABILITY:g} %"
POWER = f"power: the deviation from the published number that the verdict finds {CHANCE}"


# Our number for a claim: a value, a ratio or a slope


class OutsideGridError(Exception):
    """A claim is about a place or a result that this store does not have."""


@dataclass(frozen=True)
class Measured:
    """Our number at one place, or why there is none: ``missing`` if it was not computed, ``broken`` if it cannot be."""

    where: Mapping[str, Any]
    value: float = math.nan
    error: float = 0.0
    missing: str = ""
    broken: str = ""


def claims_of(dataset: xr.Dataset) -> list[Claim]:
    """Return the claims that a dataset carries in its attributes; raises SweepError if they cannot be read."""
    try:
        return [Claim.model_validate(claim) for claim in json.loads(dataset.attrs.get("claims", "[]"))]
    except (ValueError, TypeError) as error:
        raise SweepError(f"the attribute 'claims' cannot be read: {error}") from error


def in_words(quantity: Slope | Ratio | Reading) -> str:
    """Return how the quantity of a claim is derived."""
    name = quantity.variable + (f"[{quantity.component}]" if quantity.component else "")
    if isinstance(quantity, Slope):
        return f"slope of {name} over {quantity.over}"
    if isinstance(quantity, Ratio):
        return f"{name}({place_in_words(quantity.of)}) / {name}({place_in_words(quantity.to)})"
    return name


def unit_of(dataset: xr.Dataset, quantity: Slope | Ratio | Reading) -> str:
    """Return the unit of a result, or of its component where these differ; '' for a result that is not there, and
    for ratios and slopes.
    """
    if not isinstance(quantity, Reading) or quantity.variable not in dataset:
        return ""
    variable = dataset[quantity.variable]
    units = f"{variable.dims[-1]}_unit" if quantity.component is not None else ""
    if units in dataset.coords:
        return str(dataset[units].isel(_component(dataset, quantity)).item())
    return units_of(variable.attrs)


def measure(dataset: xr.Dataset, claim: Derived, quantity: Slope | Ratio | Reading) -> Iterator[Measured]:
    """Yield our number at every place that a claim is about; raises OutsideGridError for one that is not there."""
    if quantity.variable not in dataset:
        raise OutsideGridError(f"{quantity.variable} is not a result of this store")
    points = _points(dataset.isel(_component(dataset, quantity)), quantity.variable)
    if isinstance(quantity, Slope):
        if quantity.over not in dataset.coords:
            raise OutsideGridError(f"{quantity.over} is not an axis of this store")
        for line in _combinations(dataset, claim.where, but=str(dataset[quantity.over].dims[0])):
            yield _slope(points, line, quantity.over)
    elif isinstance(quantity, Ratio):
        differing = {str(dataset[axis].dims[0]) for axis in quantity.of if axis in dataset.coords}
        pairs = (_combinations(dataset, {**claim.where, **place}) for place in (quantity.of, quantity.to))
        for one, other in zip(*pairs, strict=True):
            yield _ratio(points, one, other, differing)
    else:
        for point in _combinations(dataset, {**claim.where, **quantity.at}):
            yield _value(points, point)


class _Points(NamedTuple):
    """A variable with one number per point: its values, one-sigma errors (0 where there are none) and status."""

    dataset: xr.Dataset
    variable: str
    values: Array
    errors: Array
    status: Array


def _points(dataset: xr.Dataset, variable: str) -> _Points:
    status, error = dataset["status"], standard_error(dataset, variable)
    errors = xr.zeros_like(status, dtype=float) if error is None else error
    values, known = (array.broadcast_like(status).transpose(*status.dims) for array in (dataset[variable], errors))
    return _Points(dataset, variable, values.values, known.values, status.values)


def _component(dataset: xr.Dataset, quantity: Slope | Ratio | Reading) -> dict[str, int]:
    if quantity.component is None:
        return {}
    dimension = str(dataset[quantity.variable].dims[-1])
    return {dimension: dataset[dimension].values.tolist().index(quantity.component)}


def _combinations(dataset: xr.Dataset, where: Mapping[str, Any], but: str = "") -> Iterator[dict[str, int]]:
    """Yield an index for each combination of the axes that ``where`` does not fix, except ``but``."""
    try:
        fixed = {dimension: hits[0] for dimension, hits in indices(dataset, where).items()}
    except SweepError as error:
        raise OutsideGridError("; ".join(error.problems)) from error
    for place in places_along(dataset, [d for d in dataset["status"].dims if d not in fixed and d != but]):
        yield fixed | place


def _value(points: _Points, index: Mapping[str, int]) -> Measured:
    where, at = place_at(points.dataset, index), tuple(index[str(d)] for d in points.dataset["status"].dims)
    if (status := int(points.status[at])) != Status.DONE:
        return Measured(where, missing=_why({status}, "the point"))
    return Measured(where, float(points.values[at]), float(points.errors[at]))


def _ratio(points: _Points, one: Mapping[str, int], other: Mapping[str, int], differing: set[str]) -> Measured:
    """Return the value at one point over that at another; its error includes their covariance."""
    where = place_at(points.dataset, {d: i for d, i in one.items() if d not in differing})
    top, bottom = _value(points, one), _value(points, other)
    if missing := top.missing or bottom.missing:
        return Measured(where, missing=missing)
    if bottom.value == 0.0 or not math.isfinite(top.value / bottom.value):
        return Measured(where, broken="the ratio is not a finite number")
    ratio = top.value / bottom.value
    weights = (1.0 / bottom.value, -ratio / bottom.value)
    error = error_of_sum(points.dataset, points.variable, one, other, weights)
    return Measured(where, ratio, 0.0 if error is None else float(error))


def _slope(points: _Points, index: Mapping[str, int], over: str) -> Measured:
    """Return the slope along a line of points; those that the study excludes do not belong to it."""
    dataset = points.dataset
    where, dimension = place_at(dataset, index), str(dataset[over].dims[0])
    line = tuple(index.get(str(d), slice(None)) for d in dataset["status"].dims)
    used = points.status[line] != Status.EXCLUDED
    status = points.status[line][used]
    if undone := np.count_nonzero(status != Status.DONE):
        some = f"{undone:,} of {len(status):,} points"
        return Measured(where, missing=_why(set(status.tolist()) - {Status.DONE}, some))
    x, y = (values[used].astype(float) for values in (dataset[over].values, points.values[line]))
    if len(x) < 2:
        return Measured(where, missing=f"a slope needs two values of {over}; this grid has {len(x)}")
    if not (np.all(x > 0.0) and np.all(np.isfinite(y)) and np.all(y > 0.0)):
        return Measured(where, broken="there are values that are not above 0, which have no power law")
    errors = points.errors[line][used]
    if (covariance := covariance_along(dataset, points.variable, dimension)) is not None:
        pair = covariance.isel({d: i for d, i in index.items() if d in covariance.dims})
        errors = pair.transpose(dimension, f"{dimension}_other").values[np.ix_(used, used)]
    try:
        law = power_law(x, y, errors, samples_along(dataset, dimension, covariance))
    except ValueError as error:
        return Measured(where, missing=str(error))
    return Measured(where, law.exponent, law.exponent_error)


def _why(codes: set[int], subject: str) -> str:
    if Status.FAILED in codes:
        return f"failed: {subject}"
    return f"excluded by the study: {subject}" if Status.EXCLUDED in codes else f"{NOT_DONE}: {subject}"


# Verdicts


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


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def _published_numbers(dataset: xr.Dataset) -> Iterator[Comparison]:
    """Yield the comparisons of NAME with NAME_published, point by point."""
    study = str(dataset.attrs.get("study_name", ""))
    for name in (n for n in map(str, dataset.data_vars) if f"{n}_published" in dataset):
        table, unit = dataset[f"{name}_published"], units_of(dataset[name].attrs)
        source, reason = str(table.attrs["source"]), str(table.attrs.get("tolerance_reason", ""))
        exact, points = standard_error(dataset, name) is None, _points(dataset, name)
        for index in np.argwhere(np.isfinite(table.values)):
            here = dict(zip(map(str, table.dims), map(int, index), strict=True))
            number, rounding = float(table[here]), float(dataset[f"{name}_published_rounding"][here])
            printed = PublishedNumber(number, rounding, source, float(table.attrs.get("tolerance", 0.0)), reason)
            if rounding == 0.5 and number.is_integer() and exact:
                printed = PublishedNumber(number, 0.0, source)  # a count
            yield judged(study, name, name, unit, _value(points, here), printed)


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


def judged(study: str, what: str, quantity: str, unit: str, ours: Measured, published: PublishedNumber) -> Comparison:
    """Return the comparison of our number with the published one."""
    allowance = published.rounding + MC_ERRORS_ALLOWED * ours.error
    passes = allowance + published.tolerance * abs(published.number) + FOUND * ours.error
    detectable = passes if math.isfinite(ours.value) and not published.not_comparable else math.nan
    verdict, reason = _verdict(ours, published, allowance)
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


def _verdict(  # noqa: PLR0911 (one return for each verdict)
    ours: Measured, published: PublishedNumber, allowance: float
) -> tuple[Verdict, str]:
    """Return the verdict and the reason for it: numbers agree only if a disagreement would have been found."""
    if ours.missing:
        return "incomplete", ours.missing
    if ours.broken or not math.isfinite(ours.value):
        return "NOT reproduced", ours.broken or "the result is not a finite number"
    if published.not_comparable:
        return "not comparable", published.not_comparable
    if not math.isfinite(ours.error):
        return "incomplete", "the error of our number is not known (docs/errors.md)"
    number, tolerance = published.number, published.tolerance * abs(published.number)
    off = abs(ours.value - number) - ARITHMETIC * abs(number)
    if off > allowance + tolerance:
        return "NOT reproduced", ""
    limits = [MOST_UNSEEN * abs(number)] if number else []
    limits += [] if published.null is None else [abs(number - published.null)]
    most = min(limits, default=math.inf)
    apart = f"more than {most:.3g}, which the verdict must find"
    if (passes := published.rounding + tolerance) > most:
        return "not comparable", f"rounding and tolerance let pass a deviation of {passes:.3g}, {apart}"
    if (passes := allowance + tolerance + FOUND * ours.error) > most:
        needed = "more realisations or catalogues are needed"
        return "incomplete", f"our Monte-Carlo error lets pass a deviation of {passes:.3g}, {apart}: {needed}"
    if off <= allowance:
        return "reproduced", ""
    return "within tolerance", f"{100.0 * published.tolerance:g} %: {published.reason}"


def summary(comparisons: Sequence[Comparison]) -> dict[Verdict, int]:
    """Return how many comparisons have each verdict."""
    counts = Counter(c.verdict for c in comparisons)
    return {verdict: counts[verdict] for verdict in VERDICTS}


def all_is_well(comparisons: Sequence[Comparison]) -> bool:
    """Return whether everything that is comparable is reproduced or within tolerance."""
    return all(c.verdict in ("reproduced", "within tolerance", "not comparable") for c in comparisons)


def remarks(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what was changed in the study, and those of `caveats`."""
    overrides = dataset.attrs.get("study_overrides")
    changed = [f"the study was changed on the command line: {overrides}"] if overrides else []
    return [*changed, *caveats(dataset)]


def caveats(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what a comparison of this dataset leaves out, and about what affects its meaning."""
    compared = [str(name).removesuffix("_published") for name in dataset.data_vars if str(name).endswith("_published")]
    compared += [claim.quantity().variable for claim in claims_of(dataset)]
    sentences = [sentence for name in dict.fromkeys(compared) for sentence in unknown_parts(dataset, name)]
    for name, variable in dataset.data_vars.items():
        if outside := int(variable.attrs.get("outside_grid", 0)):
            numbers = "1 published number is" if outside == 1 else f"{outside} published numbers are"
            sentences.append(f"{str(name).removesuffix('_published')}: {numbers} not in this grid and not compared")
    return sentences


# Tables of comparisons


def table(comparisons: Sequence[Comparison]) -> Table:
    """Return comparisons for reading: one row each below what is compared, with reasons; a single row where all places
    agree exactly.
    """
    rows: list[tuple[str, ...]] = []
    between: dict[int, list[tuple[str, str]]] = {}
    source = None
    groups: dict[tuple[str, ...], list[Comparison]] = {}
    for c in map(in_readable_unit, comparisons):
        long = place_in_words({k: v for k, v in c.where.items() if len(k) > LONG_NAME})
        groups.setdefault((c.study, c.what, c.unit, c.source, long), []).append(c)
    for (study, what, unit, cited, _), some in groups.items():
        common = {k: v for k, v in some[0].where.items() if all(k in c.where and c.where[k] == v for c in some)}
        heading = f"{study}: {what}" + (f" [{in_ascii(unit)}]" if unit else "")
        lines = [("", ""), (f"{heading}, {place_in_words(common)}" if common else heading, BOLD)]
        lines += [(cited, "\x1b[2m")] if (study, cited) != source else []
        between.setdefault(len(rows), []).extend(lines)
        source = study, cited
        if len(some) > 1 and all(c.difference == 0.0 and c.verdict == some[0].verdict for c in some):
            power = power_in_words(some[0])
            rows.append((some[0].verdict, f"all {len(some)} places", "exactly", "", "none", power, "none"))
        else:
            for c in some:
                value, published, difference, percent, allowance = numbers_in_words(c)
                place = place_in_words({k: v for k, v in c.where.items() if k not in common})
                rows.append((c.verdict, place, value, published, percent or difference, power_in_words(c), allowance))
        reasons = dict.fromkeys(f"{c.verdict}: {c.reason}" for c in some if c.reason)
        between[len(rows)] = [(reason, "") for reason in reasons]
    between[len(rows)] = [*between.get(len(rows), []), ("", ""), (POWER, "")]
    names = ("verdict", "at", "computed", "published", "difference", "power", "allowance")
    cells = list(zip(*rows, strict=True)) or [()] * len(names)
    ranks = {"power": 1, "allowance": 2}
    columns = [Column(n, c, c, quantity=n, rank=ranks.get(n, 0)) for n, c in zip(names, cells, strict=True)]
    columns[0] = replace(columns[0], left=True, styles={str(verdict): colour for verdict, colour in VERDICTS.items()})
    columns[1] = replace(columns[1], wrap=len("v_max=14.5"))
    return Table(columns, between=between)


def records(comparisons: Sequence[Comparison]) -> Table:
    """Return one row per comparison with all numbers, for programs; a missing number is an empty cell."""
    names = [field.name for field in fields(Comparison)]
    columns = {name: [finite_or(getattr(c, name), math.nan) for c in comparisons] for name in names}
    columns["where"] = list(map(place_in_words, columns["where"]))
    return Table([Column(name, values) for name, values in columns.items()])


def as_json(comparisons: Sequence[Comparison], remarks: Sequence[str] = ()) -> str:
    """Return JSON with the comparisons, their number by verdict, and remarks; a missing number is null."""
    counts = {verdict.lower().replace(" ", "_"): n for verdict, n in summary(comparisons).items()}
    return to_json({"comparisons": comparisons, "summary": counts, "remarks": remarks})


def notes(comparisons: Sequence[Comparison]) -> list[str]:
    """Return the lines below a table: where each number was published, and the reasons for verdicts."""
    sources = dict.fromkeys(f"{c.study}: {c.what}: {c.source}" for c in comparisons)
    reasons = dict.fromkeys(f"{c.study}: {c.what}: {c.verdict}: {c.reason}" for c in comparisons if c.reason)
    return [*sources, *reasons]


def summary_line(comparisons: Sequence[Comparison]) -> str:
    """Return in words how many comparisons have each verdict."""
    seldom = ("not comparable", "incomplete")
    return ", ".join(f"{n} {v.lower()}" for v, n in summary(comparisons).items() if n or v not in seldom)


def in_readable_unit(comparison: Comparison) -> Comparison:
    """Return a comparison with its numbers in the unit in which the published one reads best."""
    unit, factor = prefixed(comparison.published, comparison.unit)
    if factor == 1.0:
        return comparison
    numbers = ("value", "mc_error", "published", "rounding", "allowance", "difference", "detectable")
    return replace(comparison, unit=unit, **{name: factor * getattr(comparison, name) for name in numbers})


def numbers_in_words(c: Comparison) -> tuple[str, str, str, str, str]:
    """Return value, published number, difference (also in percent) and allowance, with significant digits only."""
    decimals = 0  # of the published number: its rounding is half a unit of the last digit
    if c.rounding > 0.0:
        decimals = min(300, max(0, -math.floor(math.log10(2.0 * c.rounding) + 1e-9)))
    exact = min(f"{c.published:g}", rounded(c.published, c.mc_error), key=len)  # no more digits than our number has
    published = f"{c.published:.{decimals}f}" if c.rounding > 0.0 else exact
    if not math.isfinite(c.value):
        return "", published, "", "", ""
    if c.mc_error > 0.0:
        value, difference = with_error(c.value, c.mc_error), rounded(c.difference, c.mc_error)
    elif c.rounding > 0.0 and c.value != round(c.value, decimals):
        value, difference = (f"{number:.{decimals + 1}f}" for number in (c.value, c.difference))
    else:
        value, difference = rounded(c.value), rounded(c.difference)
    allowance = f"{c.allowance:.2g}" if c.allowance > 0.0 else "none"
    if c.difference == 0.0:
        return value, published, "none", "", allowance
    percent = f"{100.0 * c.difference / abs(c.published):+.1f} %" if c.published else ""
    sign = "+" if c.difference > 0.0 else ""
    return value, published, sign + difference, percent.replace("-0.0", "0.0").replace("+0.0", "0.0"), allowance


def power_in_words(c: Comparison) -> str:
    """Return the deviation that the verdict finds: relative to the published number, or absolute if that is 0."""
    if not math.isfinite(c.detectable):
        return ""
    if c.detectable == 0.0:
        return "any"
    return f"{100.0 * c.power:.2g} %" if c.published else f"{c.detectable:.2g}"
