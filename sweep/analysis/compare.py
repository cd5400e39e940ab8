"""Comparison with published numbers: a verdict on every published number and every claim of a dataset.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

from __future__ import annotations  # names of xarray, which is imported only where it computes

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from linksweep.sweep.analysis import quantity
from linksweep.sweep.contract import FEW, Status
from linksweep.sweep.formatting import first_of, in_ascii, in_short, prefixed, rounded, to_json, units_of, with_error
from linksweep.sweep.studies.record import FUNCTION
from linksweep.sweep.studies.study import POINT, Derived, Ratio, Reading, Slope, printed_rounding
from linksweep.sweep.table_writer import Column, Table

if TYPE_CHECKING:
    import xarray as xr

Verdict = Literal["reproduced", "within tolerance", "NOT reproduced", "not comparable", "incomplete"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
MC_ERRORS_ALLOWED = 3.0
FINDS = 1.6449  # a deviation this many errors beyond what is allowed is found with a probability of 95 %
MOST_UNSEEN = 1.0 / 3.0  # no verdict is given that would miss a larger deviation, relative to the published number
ARITHMETIC = 1e-9  # smaller relative differences come from the arithmetic: 0.605 - 0.6 in binary is more than 0.005
NOT_DONE = "not done yet"
RANKS = {"computed": 0, "published": 0, "difference": 0, "power": 1, "allowance": 2}  # of the columns of numbers
POWER = "power: the deviation from the published number that the verdict finds with a probability of 95 %"


# Our number for a claim: a value, a ratio or a slope


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
    name = derived.variable + ("" if derived.component is None else f"[{derived.component}]")
    if isinstance(derived, Slope):
        return f"slope of {name} over {derived.over}"
    if isinstance(derived, Ratio):
        return f"{name}({quantity.place_in_words(derived.of)}) / {name}({quantity.place_in_words(derived.to)})"
    return name


def unit_of(dataset: xr.Dataset, derived: Slope | Ratio | Reading) -> str:
    """Return the unit of a result, or of its component where these differ; '' for a result that is not there, and
    for ratios and slopes.
    """
    part, problem = _part_with(dataset, derived.variable, derived.component)
    is_reading = isinstance(derived, Reading) and not problem
    return quantity.units_along(part, derived.variable, [])[0] if is_reading else ""


def measure(dataset: xr.Dataset, claim: Derived, derived: Slope | Ratio | Reading) -> list[Measured]:
    """Return our number at every place that a claim is about, but where the study has no point unless that is all;
    raises OutsideGridError for a place that is not in the grid.
    """
    name = derived.variable
    part, problem = _part_with(dataset, name, derived.component)
    if problem:
        return [Measured(claim.where, missing=problem)]
    if isinstance(derived, Slope):
        everywhere = list(_slopes(part, name, derived.over, _fixed(dataset, claim.where)))
    else:
        ends = (derived.of, derived.to) if isinstance(derived, Ratio) else (derived.at,)
        everywhere = list(_values(part, name, [_fixed(dataset, {**claim.where, **end}) for end in ends]))
    return [one for one in everywhere if one.missing != quantity.EXCLUDED] or everywhere


def _part_with(dataset: xr.Dataset, name: str, component: str | float | None = None) -> tuple[xr.Dataset, str]:
    """Return the part where a result is one number at each point, which is that of its component if it has any, and why
    there is none, '' if there is.
    """
    if name not in dataset:
        is_begun = Status.DONE in dataset["status"].values
        return dataset, f"{name} is not a result of this store" if is_begun else NOT_DONE
    dims = quantity.own_dimensions(dataset, name)
    if dataset[name].dtype.kind not in "biuf" or len(dims) > 1:
        return dataset, f"{name} is neither one number at each point nor one for each component"
    labels = [label for dim in dims for label in dataset[dim].values]
    meant = [i for i, label in enumerate(labels) if quantity.is_meant(label, component)]
    if not meant and (labels or component is not None):
        wanted = f"one of {first_of(labels, FEW)}" if labels else "left out"
        return dataset, f"the component of {name} must be {wanted}"
    return dataset.isel(dict(zip(dims, meant, strict=False))), ""


def _fixed(dataset: xr.Dataset, where: Mapping[str, Any]) -> dict[str, int]:
    there = quantity.indices(dataset, where)
    if any(len(hits) > 1 for hits in there.values()):
        raise quantity.OutsideGridError(f"several points of the store have {quantity.place_in_words(where)}")
    return {dimension: hits[0] for dimension, hits in there.items()}


def _values(dataset: xr.Dataset, name: str, places: Sequence[dict[str, int]]) -> Iterator[Measured]:
    """Yield the number at every point at which some axes are fixed; where they are at two places, that at the first
    over that at the second.
    """
    parts = [dataset.isel(place) for place in places]
    dims = parts[0][name].dims
    numbers = parts[0][name].values, quantity.sigmas(parts[0], name, dims)
    if len(places) == 2:
        numbers = quantity.ratio_at(dataset, name, *places)
    status = (part["status"].transpose(*dims).values for part in parts)
    common = dict(set.intersection(*({*place.items()} for place in places)))
    columns = (one.reshape(-1).tolist() for one in (*numbers, *status))
    for along, value, error, *codes in zip(quantity.places_along(dataset, dims), *columns, strict=True):
        where, done = quantity.place_at(dataset, common | along), {*codes} == {Status.DONE}
        yield Measured(where, value, error) if done else Measured(where, missing=_why({*codes}, "the point"))


def _slopes(dataset: xr.Dataset, name: str, over: str, fixed: dict[str, int]) -> Iterator[Measured]:
    """Yield the slope along every line of points at which some axes are fixed; points that the study excludes do not
    belong to it.
    """
    from linksweep.sweep.analysis import laws  # of the three only this is fitted

    axis = dataset.coords.get(over)
    if axis is None or not axis.dims or (axis.dims == (POINT,) and len(quantity.varied_parameters(dataset)) > 1):
        raise quantity.OutsideGridError(f"{over} is not an axis of this store")
    for line in laws.lines_of(dataset.isel(fixed), name, over).lines:
        where, n = quantity.place_at(dataset, fixed | dict(line.index)), len(line.x)
        if undone := np.count_nonzero(line.status != Status.DONE):
            yield Measured(where, missing=_why(set(line.status.tolist()), f"{undone:,} of {n:,} points"))
        elif n < 2:
            few = f"a slope needs two values of {over}; this grid has {n}"
            yield Measured(where, missing=few if n else quantity.EXCLUDED)
        elif not (np.all(line.x > 0.0) and np.all(np.isfinite(line.y)) and np.all(line.y > 0.0)):
            yield Measured(where, broken="there are values that are not above 0, which have no power law")
        else:
            try:
                law = line.fitted(laws.power_law)
                yield Measured(where, law["exponent"], law["exponent_error"])
            except ValueError as error:
                yield Measured(where, missing=str(error))


def _why(codes: set[int], subject: str) -> str:
    if Status.FAILED in codes:
        return f"failed: {subject}"
    return quantity.EXCLUDED if Status.EXCLUDED in codes else f"{NOT_DONE}: {subject}"


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


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def _published_numbers(dataset: xr.Dataset) -> Iterator[Comparison]:
    """Yield the comparisons of NAME with NAME_published, point by point."""
    for name in (n for n in map(str, dataset.data_vars) if f"{n}_published" in dataset):
        table, unit = dataset[f"{name}_published"], units_of(dataset[name].attrs)
        _, problem = _part_with(dataset, name)
        about = _about(dataset, name, name, unit, str(table.attrs["source"]))
        is_mean = quantity.standard_error(dataset, name) is not None
        is_count = dataset[name].dtype.kind in "iu" or not (is_mean or unit or FUNCTION in dataset.attrs)
        tolerance, reason = float(table.attrs.get("tolerance", 0.0)), str(table.attrs.get("tolerance_reason", ""))
        for index in np.argwhere(np.isfinite(table.values)):
            here = dict(zip(map(str, table.dims), map(int, index), strict=True))
            number, rounding = float(table[here]), float(dataset[f"{name}_published_rounding"][here])
            ours = Measured({}, missing=problem) if problem else next(_values(dataset, name, [here]))
            is_exact = is_count and rounding == 0.5 and number.is_integer()
            if is_exact:
                yield judged(about, ours, number, rounding=0.0)
            else:
                yield judged(about, ours, number, rounding, tolerance, reason)
        if table.attrs.get("outside_grid") and not np.isfinite(table.values).any():
            yield judged(about, Measured({}, missing=_outside(table)), math.nan, math.nan)
    for name in json.loads(dataset.attrs.get("published_not_compared", "[]")):
        source = json.loads(dataset.attrs["study_document"])["published"]["source"]
        ours = Measured({}, missing=_part_with(dataset, name)[1])
        yield judged(_about(dataset, name, name, "", source), ours, math.nan, math.nan)


def _outside(table: xr.DataArray) -> str:
    """Return in words how many published numbers are not in the grid; '' if all are."""
    lacking = f" (the table has no column {names})" if (names := table.attrs.get("without_column")) else ""
    n = int(table.attrs.get("outside_grid", 0))
    return f"published numbers that are not in this grid and not compared: {n}{lacking}" if n else ""


def _claims(dataset: xr.Dataset) -> Iterator[Comparison]:
    for claim in quantity.claims_of(dataset):
        derived = claim.quantity()
        try:
            measured = measure(dataset, claim, derived)
        except quantity.OutsideGridError as error:
            measured = [Measured(claim.where, missing="; ".join(error.problems))]
        about = _about(dataset, claim.text, in_words(derived), unit_of(dataset, derived), claim.source)
        number, rounding = float(claim.published), 0.0 if claim.exact else printed_rounding(claim.published)
        tolerance, reason = claim.tolerance or 0.0, claim.tolerance_reason or ""
        for one in measured:
            yield judged(about, one, number, rounding, tolerance, reason, claim.null, claim.not_comparable or "")


def _about(dataset: xr.Dataset, what: str, derived: str, unit: str, source: str) -> dict[str, str]:
    study = str(dataset.attrs.get("study_name", ""))
    return {"study": study, "what": what, "quantity": derived, "unit": unit, "source": source}


def judged(
    about: Mapping[str, Any],
    ours: Measured,
    number: float,
    rounding: float,
    tolerance: float = 0.0,
    reason: str = "",
    null: float | None = None,
    not_comparable: str = "",
) -> Comparison:
    """Return the comparison of our number with a published one and its ``rounding``.

    There may be a relative ``tolerance``, with the ``reason`` for it; ``null``, the value expected without the effect
    that the number shows, which a verdict must tell from it; and why there can be no verdict.
    """
    # numbers agree only if a disagreement would have been found
    allowance, allowed = rounding + MC_ERRORS_ALLOWED * ours.error, tolerance * abs(number)
    detectable = allowance + allowed + FINDS * ours.error
    off = abs(ours.value - number) - ARITHMETIC * abs(number)
    most = min(MOST_UNSEEN * abs(number) if number else math.inf, math.inf if null is None else abs(number - null))
    passes = rounding + allowed
    shown, passed, noticed = (in_short(one, 0.0, about["unit"]) for one in (most, passes, detectable))
    apart = f"more than {shown}, which the verdict must find"
    passing = f"our Monte-Carlo error lets pass a deviation of {noticed}, {apart}"
    cases: list[tuple[bool, Verdict, str]] = [  # the first that is true
        (bool(ours.missing), "incomplete", ours.missing),
        (not math.isfinite(ours.value), "NOT reproduced", ours.broken or "the result is not a finite number"),
        (bool(not_comparable), "not comparable", not_comparable),
        (not math.isfinite(ours.error), "incomplete", "the error of our number is not known (docs/errors.md)"),
        (off > allowance + allowed, "NOT reproduced", ""),
        (passes > most, "not comparable", f"rounding and tolerance let pass a deviation of {passed}, {apart}"),
        (detectable > most, "incomplete", f"{passing}: more realisations or catalogues are needed"),
        (off > allowance, "within tolerance", f"{100.0 * tolerance:g} %: {reason}"),
        (True, "reproduced", ""),
    ]
    _, verdict, why = next(case for case in cases if case[0])
    if not_comparable or not math.isfinite(ours.value):
        detectable = math.nan
    numbers: dict[str, Any] = {"value": ours.value, "mc_error": ours.error, "published": number, "rounding": rounding}
    numbers |= {"allowance": allowance, "difference": ours.value - number, "detectable": detectable}
    numbers["power"] = detectable / abs(number) if number else math.nan
    return Comparison(**about, where=ours.where, **numbers, verdict=verdict, reason=why)


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
    published = (name for name in map(str, dataset.data_vars) if name.endswith("_published"))
    tables = {name.removesuffix("_published"): dataset[name] for name in published}
    compared = dict.fromkeys([*tables, *(claim.quantity().variable for claim in quantity.claims_of(dataset))])
    sentences = [part for name in compared for part in quantity.unknown_parts(dataset, name)]
    return [*sentences, *(f"{name}: {words}" for name, table in tables.items() if (words := _outside(table)))]


# Tables of comparisons


def tables(comparisons: Sequence[Comparison]) -> Iterator[Table]:
    """Yield a table for reading of each thing that is compared, under where it was published."""
    readable = list(map(in_readable_unit, comparisons))
    for group in dict.fromkeys((c.study, c.what, c.unit, c.source) for c in readable):
        some = [c for c in readable if (c.study, c.what, c.unit, c.source) == group]
        axes = dict.fromkeys(axis for c in some for axis in c.where)
        places = {axis: [c.where.get(axis, "") for c in some] for axis in axes}
        common = {axis: values[0] for axis, values in places.items() if len(set(values)) == 1}
        what, _, verdict, *numbers = table(some).columns
        title = ", ".join(filter(None, [f"{group[0]}: {what.values[0]}", quantity.place_in_words(common)]))
        along = [Column(axis, values) for axis, values in places.items() if axis not in common]
        yield Table([verdict, *along, *numbers[:-1]], f"{title}\n{group[3]}")


def table(comparisons: Sequence[Comparison]) -> Table:
    """Return one table of comparisons for reading."""
    readable = list(map(in_readable_unit, comparisons))
    what = [f"{c.what} [{in_ascii(c.unit)}]" if c.unit else c.what for c in readable]
    columns = [Column("what", what), Column("where", [quantity.place_in_words(c.where) for c in readable])]
    columns.append(Column("verdict", [c.verdict for c in readable], left=True))
    numbers = list(map(_numbers, readable))
    for name, rank in RANKS.items():
        values, cells = zip(*(one[name] for one in numbers), strict=True)
        columns.append(Column(name, values, cells, rank=rank))
    return Table([*columns, Column("source", [c.source for c in readable])])


def as_json(comparisons: Sequence[Comparison], remarks: Sequence[str] = ()) -> str:
    """Return JSON with the comparisons, their number by verdict, and remarks; a missing number is null."""
    counts = {verdict.lower().replace(" ", "_"): n for verdict, n in summary(comparisons).items()}
    return to_json({"comparisons": comparisons, "summary": counts, "remarks": remarks})


def notes(comparisons: Sequence[Comparison]) -> list[str]:
    """Return the lines below a table: the reasons for verdicts, and what a column means."""
    reasons = dict.fromkeys(f"{c.study}: {c.what}: {c.verdict}: {c.reason}" for c in comparisons if c.reason)
    return [*reasons, *([POWER] if comparisons else [])]


def in_readable_unit(comparison: Comparison) -> Comparison:
    """Return a comparison with its numbers in the unit in which the published one reads best."""
    unit, factor = prefixed(comparison.published, comparison.unit)
    numbers = ("value", "mc_error", "published", "rounding", "allowance", "difference", "detectable")
    return replace(comparison, unit=unit, **{name: factor * getattr(comparison, name) for name in numbers})


def _numbers(c: Comparison) -> dict[str, tuple[float, str]]:
    """Return the numbers of a comparison, each to sort by and in words with significant digits only: the difference
    and the power in percent of the published number, or as they are if that is 0.
    """
    published = min(f"{c.published:g}", rounded(c.published, c.mc_error), key=len)  # no more digits than ours has
    if c.rounding > 0.0:  # half a unit of the last printed digit
        decimals = math.floor(math.log10(2.0 * c.rounding) + 1e-9)
        published = f"{c.published:.{min(300, max(0, -decimals))}f}"
    sigma = c.mc_error if c.mc_error > 0.0 else 0.0 if c.value % 1.0 == 0.0 else c.rounding
    value = with_error(c.value, c.mc_error) if c.mc_error > 0.0 else rounded(c.value, sigma)
    difference, power = f"{'+' * (c.difference > 0.0)}{rounded(c.difference, sigma)}", f"{c.detectable:.2g}"
    if c.published:
        difference, power = f"{100.0 * c.difference / abs(c.published):+.1f} %", f"{100.0 * c.power:.2g} %"
    power = "any" if c.detectable == 0.0 else power if math.isfinite(c.detectable) else ""
    allowance = f"{c.allowance:.2g}" if c.allowance > 0.0 else "none"
    numbers = {
        "computed": (c.value, value),
        "published": (c.published, published),
        "difference": (c.difference / abs(c.published or 1.0), difference if c.difference else "none"),
        "power": (c.power if c.published else c.detectable, power),
        "allowance": (c.allowance, allowance),
    }
    is_known = math.isfinite(c.value)
    return {name: (number, text if is_known or name == "published" else "") for name, (number, text) in numbers.items()}
