"""Comparison with published numbers: a verdict on every published number and every claim of a dataset.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import xarray as xr

from linksweep.sweep.analysis import fits, laws, quantity
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import finite_or, in_ascii, prefixed, rounded, to_json, units_of, with_error
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import Claim, Derived, Ratio, Reading, Slope, printed_rounding
from linksweep.sweep.table_writer import BOLD, LONG_NAME, Column, Table

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete"]
# the verdicts, and their colours on a terminal
VERDICTS: Mapping[Verdict, str] = {
    "reproduced": "\x1b[32m",
    "within tolerance": "\x1b[33m",
    "NOT reproduced": "\x1b[1;31m",
    "not comparable": "\x1b[2m",
    "incomplete": "\x1b[33m",
}
MC_ERRORS_ALLOWED = 3.0
FINDS = 1.6449  # a deviation this many errors beyond what is allowed is found with a probability of 95 %
MOST_UNSEEN = 1.0 / 3.0  # no verdict is given that would miss a larger deviation, relative to the published number
ARITHMETIC = 1e-9  # smaller relative differences come from the arithmetic: 0.605 - 0.6 in binary is more than 0.005
NOT_DONE = "not done yet"
POWER = "power: the deviation from the published number that the verdict finds with a probability of 95 %"


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


def in_words(derived: Slope | Ratio | Reading) -> str:
    """Return how the quantity of a claim is derived."""
    name = derived.variable + (f"[{derived.component}]" if derived.component else "")
    if isinstance(derived, Slope):
        return f"slope of {name} over {derived.over}"
    if isinstance(derived, Ratio):
        return f"{name}({quantity.place_in_words(derived.of)}) / {name}({quantity.place_in_words(derived.to)})"
    return name


def unit_of(dataset: xr.Dataset, derived: Slope | Ratio | Reading) -> str:
    """Return the unit of a result, or of its component where these differ; '' for a result that is not there, and
    for ratios and slopes.
    """
    if not isinstance(derived, Reading) or derived.variable not in dataset:
        return ""
    part = _of_component(dataset, derived)
    dimension = dataset[derived.variable].dims[-1:]
    units = f"{dimension[0]}_unit" if derived.component is not None else ""
    return str(part[units].item()) if units in part.coords else units_of(part[derived.variable].attrs)


def measure(dataset: xr.Dataset, claim: Derived, derived: Slope | Ratio | Reading) -> Iterator[Measured]:
    """Yield our number at every place that a claim is about; raises OutsideGridError for one that is not there."""
    name = derived.variable
    if name not in dataset:
        raise OutsideGridError(f"{name} is not a result of this store")
    part = _of_component(dataset, derived)
    if isinstance(derived, Slope):
        if derived.over not in dataset.coords:
            raise OutsideGridError(f"{derived.over} is not an axis of this store")
        fixed = _fixed(dataset, claim.where)
        along = laws.lines_of(part.isel(fixed), name, derived.over)
        for line in along.lines:
            yield _slope(line, quantity.place_at(dataset, fixed | dict(line.index)), derived.over)
    elif isinstance(derived, Ratio):
        differing = {str(dataset[axis].dims[0]) for axis in derived.of if axis in dataset.coords}
        pairs = (_values(part, name, _fixed(dataset, {**claim.where, **at})) for at in (derived.of, derived.to))
        for (one, top), (other, bottom) in zip(*pairs, strict=True):
            where = quantity.place_at(dataset, {d: i for d, i in one.items() if d not in differing})
            yield _ratio(part, name, where, (one, other), (top, bottom))
    else:
        for _, one in _values(part, name, _fixed(dataset, {**claim.where, **derived.at})):
            yield one


def _of_component(dataset: xr.Dataset, derived: Slope | Ratio | Reading) -> xr.Dataset:
    if derived.component is None:
        return dataset
    dimension = str(dataset[derived.variable].dims[-1])
    return dataset.isel({dimension: dataset[dimension].values.tolist().index(derived.component)})


def _fixed(dataset: xr.Dataset, where: Mapping[str, Any]) -> dict[str, int]:
    try:
        return {dimension: hits[0] for dimension, hits in quantity.indices(dataset, where).items()}
    except SweepError as error:
        raise OutsideGridError("; ".join(error.problems)) from error


def _values(dataset: xr.Dataset, name: str, fixed: Mapping[str, int]) -> Iterator[tuple[dict[str, int], Measured]]:
    """Yield index and number of every point at which some axes are fixed."""
    part = dataset.isel(fixed)
    dims, error = part["status"].dims, quantity.standard_error(part, name)
    arrays = (part["status"], part[name], xr.zeros_like(part["status"], dtype=float) if error is None else error)
    columns = (array.broadcast_like(part["status"]).transpose(*dims).values.reshape(-1).tolist() for array in arrays)
    for place, status, value, sigma in zip(quantity.places_along(part, dims), *columns, strict=True):
        index = {**fixed, **place}
        where = quantity.place_at(dataset, index)
        done = status == Status.DONE
        yield index, Measured(where, value, sigma) if done else Measured(where, missing=_why({status}, "the point"))


def _ratio(
    dataset: xr.Dataset,
    name: str,
    where: Mapping[str, Any],
    places: tuple[Mapping[str, int], Mapping[str, int]],
    numbers: tuple[Measured, Measured],
) -> Measured:
    """Return the number at one point over that at another; its error includes their covariance."""
    top, bottom = numbers
    if missing := top.missing or bottom.missing:
        return Measured(where, missing=missing)
    if bottom.value == 0.0 or not math.isfinite(top.value / bottom.value):
        return Measured(where, broken="the ratio is not a finite number")
    ratio = top.value / bottom.value
    error = quantity.error_of_sum(dataset, name, *places, (1.0 / bottom.value, -ratio / bottom.value))
    return Measured(where, ratio, 0.0 if error is None else float(error))


def _slope(line: laws.Line, where: Mapping[str, Any], over: str) -> Measured:
    """Return the slope along a line of points; those that the study excludes do not belong to it."""
    if undone := np.count_nonzero(line.status != Status.DONE):
        some = f"{undone:,} of {len(line.x):,} points"
        return Measured(where, missing=_why(set(line.status.tolist()) - {Status.DONE}, some))
    if len(line.x) < 2:
        return Measured(where, missing=f"a slope needs two values of {over}; this grid has {len(line.x)}")
    if not (np.all(line.x > 0.0) and np.all(np.isfinite(line.y)) and np.all(line.y > 0.0)):
        return Measured(where, broken="there are values that are not above 0, which have no power law")
    try:
        law = fits.power_law(line.x, line.y, line.errors, line.samples)
    except ValueError as error:
        return Measured(where, missing=str(error))
    return Measured(where, law.exponent, law.exponent_error)


def _why(codes: set[int], subject: str) -> str:
    if Status.FAILED in codes:
        return f"failed: {subject}"
    return f"excluded by the study: {subject}" if Status.EXCLUDED in codes else f"{NOT_DONE}: {subject}"


# Verdicts


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


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def _published_numbers(dataset: xr.Dataset) -> Iterator[Comparison]:
    """Yield the comparisons of NAME with NAME_published, point by point."""
    study = str(dataset.attrs.get("study_name", ""))
    for name in (n for n in map(str, dataset.data_vars) if f"{n}_published" in dataset):
        table, unit = dataset[f"{name}_published"], units_of(dataset[name].attrs)
        about, exact = table.attrs, quantity.standard_error(dataset, name) is None
        for index in np.argwhere(np.isfinite(table.values)):
            here = dict(zip(map(str, table.dims), map(int, index), strict=True))
            number, rounding = float(table[here]), float(dataset[f"{name}_published_rounding"][here])
            tolerance, reason = float(about.get("tolerance", 0.0)), str(about.get("tolerance_reason", ""))
            if rounding == 0.5 and number.is_integer() and exact:
                rounding, tolerance = 0.0, 0.0  # a count
            printed = PublishedNumber(number, rounding, str(about["source"]), tolerance, reason)
            ((_, ours),) = _values(dataset, name, here)
            yield judged(study, name, name, unit, ours, printed)


def _claims(dataset: xr.Dataset) -> Iterator[Comparison]:
    study = str(dataset.attrs.get("study_name", ""))
    for claim in quantity.claims_of(dataset):
        derived = claim.quantity()
        try:
            measured = list(measure(dataset, claim, derived))
        except OutsideGridError as error:
            measured = [Measured(claim.where, missing=str(error))]
        for one in measured:
            yield judged(study, claim.text, in_words(derived), unit_of(dataset, derived), one, _published(claim))


def _published(claim: Claim) -> PublishedNumber:
    return PublishedNumber(
        number=float(claim.published),
        rounding=0.0 if claim.exact else printed_rounding(claim.published),
        source=claim.source,
        tolerance=claim.tolerance or 0.0,
        reason=claim.tolerance_reason or "",
        null=claim.null,
        not_comparable=claim.not_comparable or "",
    )


def judged(study: str, what: str, derived: str, unit: str, ours: Measured, published: PublishedNumber) -> Comparison:
    """Return the comparison of our number with the published one."""
    number, rounding = published.number, published.rounding
    allowance = rounding + MC_ERRORS_ALLOWED * ours.error
    detectable, power = allowance + published.tolerance * abs(number) + FINDS * ours.error, math.nan
    if published.not_comparable or not math.isfinite(ours.value):
        detectable = math.nan
    if number:
        power = detectable / abs(number)
    name, value, error, apart = derived, ours.value, ours.error, ours.value - number
    verdict, reason = _verdict(ours, published, allowance)
    numbers = (value, error, number, rounding, allowance, apart, detectable, power)
    return Comparison(study, what, name, ours.where, unit, *numbers, verdict, published.source, reason)


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
    if (passes := allowance + tolerance + FINDS * ours.error) > most:
        needed = "more realisations or catalogues are needed"
        return "incomplete", f"our Monte-Carlo error lets pass a deviation of {passes:.3g}, {apart}: {needed}"
    if off <= allowance:
        return "reproduced", ""
    return "within tolerance", f"{100.0 * published.tolerance:g} %: {published.reason}"


def summary(comparisons: Sequence[Comparison]) -> dict[Verdict, int]:
    """Return how many comparisons have each verdict."""
    counts = Counter(c.verdict for c in comparisons)
    return {verdict: counts[verdict] for verdict in VERDICTS}


def summary_line(comparisons: Sequence[Comparison]) -> str:
    """Return in words how many comparisons have each verdict."""
    seldom = ("not comparable", "incomplete")
    return ", ".join(f"{n} {v.lower()}" for v, n in summary(comparisons).items() if n or v not in seldom)


def all_is_well(comparisons: Sequence[Comparison]) -> bool:
    """Return whether everything that is comparable is reproduced or within tolerance."""
    return all(c.verdict in ("reproduced", "within tolerance", "not comparable") for c in comparisons)


def remarks(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what a comparison of this dataset leaves out, and about what affects its meaning."""
    sentences = []
    compared = [str(name).removesuffix("_published") for name in dataset.data_vars if str(name).endswith("_published")]
    compared += [claim.quantity().variable for claim in quantity.claims_of(dataset)]
    sentences += [part for name in dict.fromkeys(compared) for part in quantity.unknown_parts(dataset, name)]
    for name, variable in dataset.data_vars.items():
        if outside := int(variable.attrs.get("outside_grid", 0)):
            result = str(name).removesuffix("_published")
            sentences.append(f"{result}: published numbers that are not in this grid and not compared: {outside}")
    return sentences


# Tables of comparisons


def table(comparisons: Sequence[Comparison]) -> Table:
    """Return comparisons for reading: one row each below what is compared, with reasons; a single row where all places
    agree exactly.
    """
    rows: list[tuple[str, ...]] = []
    between: dict[int, list[tuple[str, str]]] = {}
    groups: dict[tuple[str, ...], list[Comparison]] = {}
    for c in map(in_readable_unit, comparisons):
        heading = f"{c.study}: {c.what}" + (f" [{in_ascii(c.unit)}]" if c.unit else "")
        # a long name of an axis, if in a column of its own, would leave no room for numbers
        long = quantity.place_in_words({k: v for k, v in c.where.items() if len(k) > LONG_NAME})
        groups.setdefault((heading, c.source, long), []).append(c)
    cited = None
    for (heading, source, _), some in groups.items():
        common = {k: v for k, v in some[0].where.items() if all(c.where.get(k) == v for c in some)}
        whole = ", ".join(filter(None, [heading, quantity.place_in_words(common)]))
        lines = [("", ""), (whole, BOLD), *([(source, "\x1b[2m")] if source != cited else [])]
        cited = source
        between.setdefault(len(rows), []).extend(lines)
        if len(some) > 1 and all(c.difference == 0.0 and c.verdict == some[0].verdict for c in some):
            rows.append(
                (some[0].verdict, f"all {len(some)} places", "exactly", "", "none", power_in_words(some[0]), "")
            )
        else:
            rows += [_row(c, common) for c in some]
        reasons = dict.fromkeys(f"{c.verdict}: {c.reason}" for c in some if c.reason)
        between[len(rows)] = [(reason, "") for reason in reasons]
    between.setdefault(len(rows), []).extend([("", ""), (POWER, "")])
    names = ("verdict", "at", "computed", "published", "difference", "power", "allowance")
    cells = list(zip(*rows, strict=True)) or [()] * len(names)
    ranks = {"power": 1, "allowance": 2}
    columns = [Column(n, c, c, quantity=n, rank=ranks.get(n, 0)) for n, c in zip(names, cells, strict=True)]
    columns[0] = replace(columns[0], left=True, styles={str(verdict): colour for verdict, colour in VERDICTS.items()})
    columns[1] = replace(columns[1], wrap=len("v_max=14.5"))
    return Table(columns, between=between)


def _row(c: Comparison, common: Mapping[str, Any]) -> tuple[str, ...]:
    value, published, difference, percent, allowance = numbers_in_words(c)
    place = quantity.place_in_words({k: v for k, v in c.where.items() if k not in common})
    return c.verdict, place, value, published, percent or difference, power_in_words(c), allowance


def records(comparisons: Sequence[Comparison]) -> Table:
    """Return one row per comparison with all numbers, for programs; a missing number is an empty cell."""
    names = [field.name for field in fields(Comparison)]
    columns = {name: [finite_or(getattr(c, name), math.nan) for c in comparisons] for name in names}
    columns["where"] = list(map(quantity.place_in_words, columns["where"]))
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


def in_readable_unit(comparison: Comparison) -> Comparison:
    """Return a comparison with its numbers in the unit in which the published one reads best."""
    unit, factor = prefixed(comparison.published, comparison.unit)
    numbers = ("value", "mc_error", "published", "rounding", "allowance", "difference", "detectable")
    return replace(comparison, unit=unit, **{name: factor * getattr(comparison, name) for name in numbers})


def numbers_in_words(c: Comparison) -> tuple[str, str, str, str, str]:
    """Return value, published number, difference (also in percent) and allowance, with significant digits only."""
    published = min(f"{c.published:g}", rounded(c.published, c.mc_error), key=len)  # no more digits than ours has
    if c.rounding > 0.0:  # half a unit of the last printed digit
        decimals = math.floor(math.log10(2.0 * c.rounding) + 1e-9)
        published = f"{c.published:.{min(300, max(0, -decimals))}f}"
    if not math.isfinite(c.value):
        return "", published, "", "", ""
    sigma = c.mc_error if c.mc_error > 0.0 else 0.0 if float(c.value).is_integer() else c.rounding
    value = with_error(c.value, c.mc_error) if c.mc_error > 0.0 else rounded(c.value, sigma)
    allowance = f"{c.allowance:.2g}" if c.allowance > 0.0 else "none"
    if c.difference == 0.0:
        return value, published, "none", "", allowance
    sign = "+" if c.difference > 0.0 else ""
    percent = f"{100.0 * c.difference / abs(c.published):+.1f} %" if c.published else ""
    return value, published, sign + rounded(c.difference, sigma), percent, allowance


def power_in_words(c: Comparison) -> str:
    """Return the deviation that the verdict finds: relative to the published number, or absolute if that is 0."""
    if not math.isfinite(c.detectable):
        return ""
    if c.detectable == 0.0:
        return "any"
    return f"{100.0 * c.power:.2g} %" if c.published else f"{c.detectable:.2g}"
