"""Computed against published: every published number of a dataset, and every claim, with its verdict.

A number is reproduced if it differs from the published one by no more than the allowance: half a unit of the last
printed digit plus three times our own Monte-Carlo error.  The error of the published number itself, which comes from a
Monte Carlo too, is not printed anywhere and not allowed for.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from sweep.analysis.measured_claims import OutsideGridError, Points, claims_of, in_words, measure, unit_of
from sweep.analysis.quantity import OLD_ERRORS, has_old_errors, standard_error, unknown_parts
from sweep.analysis.verdicts import VERDICTS, Comparison, Measured, PublishedNumber, Verdict, judged
from sweep.attributes import units_of
from sweep.contract import SweepError
from sweep.studies.form import printed_rounding


def compare(dataset: xr.Dataset) -> list[Comparison]:
    """Return a comparison for every published number and every claim of a dataset of results; empty if it has none."""
    return [*_published_numbers(dataset), *_claims(dataset)]


def remarks(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what a comparison of this dataset does not show or that changes what it means."""
    sentences = []
    if overrides := dataset.attrs.get("study_overrides"):
        sentences.append(f"the study was changed on the command line: {overrides}")
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
        return PublishedNumber(number, 0.0, source)  # a number of things
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
