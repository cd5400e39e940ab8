"""Statistics of the realisations of a plain function, each with its Monte-Carlo error.

Mean, spread and extremes come from moments that merge block by block (Chan et al. 1983, Pebay 2008), quantiles from the
realisations themselves.  The truth is within two errors 95 times of 100, also for skewed laws, from 50 realisations on;
an error that cannot promise this is NaN.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, Outcome, Output, ResultError, Rows, shown, suggest
from linksweep.sweep.contract.rows import FEWEST_SAMPLES, Reducer, enlarged_error
from linksweep.sweep.functions.results import NUMBERS, Field, Layout, as_row, layout_differences

# What a block keeps of each number of an output: mean, sums of 2nd to 4th powers about it, least and largest value.
MOMENTS = 6

# The statistics besides quantiles, in words.
WORDS = {
    **{"mean": "mean", "std": "standard deviation", "min": "least", "max": "largest"},
    **{"count": "number of true", "median": "median"},
}

# The statistics of an output that declares none.
DEFAULT = ("mean", "std")

QUANTILE = re.compile(r"q(\d{1,2}(?:\.\d+)?)")

# Errors are made so that the truth is within this many of them as often as for a normal law.
SIGMAS = 2.0

TAIL = 0.5 * math.erfc(SIGMAS / math.sqrt(2.0))

# The fewest realisations for which the error of a standard deviation is known.
FEWEST_FOR_STD = 50

# The fewest different values between the limits of a quantile for which its error is known.
FEWEST_VALUES = 4

# Squared skewness, over the number of realisations, above which one realisation outweighs all others: it is (n - 2)^2/
# (n^2 - n) where one differs from the others, which are alike.
ONE_DECIDES = 0.7

# Relative rounding error of a variance, generously.
SAME = 1e-6


def statistic_problem(name: object) -> str | None:
    """Return what is wrong with the name of a statistic, None if nothing is."""
    if name in WORDS or (isinstance(name, str) and quantile_of(name) is not None):
        return None
    hint = suggest(name, list(WORDS)) if isinstance(name, str) else ""
    return f"there is no statistic {shown(name)}{hint}; quantiles are written q5, q95, q99.9"


def quantile_of(name: str) -> float | None:
    """Return the level of the quantile of this name, between 0 and 1; None for another statistic."""
    if name == "median":
        return 0.5
    match = QUANTILE.fullmatch(name)
    level = float(match[1]) / 100.0 if match else 0.0
    return level if 0.0 < level < 1.0 else None


def _words(name: str) -> str:
    return WORDS.get(name) or f"{100.0 * (quantile_of(name) or 0.0):g} % quantile"


def unknown(name: str, field: Field) -> str:
    """Return where the error of a statistic is NaN, in words; '' for nowhere."""
    if (level := quantile_of(name)) is not None:
        return f"below {fewest_for(level)} realisations, and where values repeat around the quantile"
    if field.type == "bool":
        return ""
    fewest = FEWEST_SAMPLES if name == "mean" else FEWEST_FOR_STD
    return f"below {fewest} realisations, and where all are alike or one outweighs all others"


def moments_of(values: Array) -> Array:
    """Return the moments of realisations (n, size), shape (MOMENTS, size)."""
    mean = values.mean(axis=0)
    deviation = values - mean
    squares = deviation**2
    powers = [squares.sum(axis=0), (squares * deviation).sum(axis=0), (squares**2).sum(axis=0)]
    return np.stack([mean, *powers, values.min(axis=0), values.max(axis=0)])


def merged(one: Array, n_one: Array, other: Array, n_other: Array) -> Array:
    """Return the moments of two sets of realisations together, each (points, MOMENTS, size), of so many (points,)."""
    n_one, n_other = n_one[:, None], n_other[:, None]
    n = n_one + n_other
    mean_a, m2_a, m3_a, m4_a, low_a, high_a = one.swapaxes(0, 1)
    mean_b, m2_b, m3_b, m4_b, low_b, high_b = other.swapaxes(0, 1)
    shift = mean_b - mean_a
    a, b = n_one / n, n_other / n
    mean = mean_a + shift * b  # not the mean of sums: it stays exact far from zero
    m2 = m2_a + m2_b + shift**2 * n_one * b
    m3 = m3_a + m3_b + shift**3 * n_one * b * (a - b) + 3.0 * shift * (a * m2_b - b * m2_a)
    m4 = m4_a + m4_b + shift**4 * n_one * b * (a * a - a * b + b * b)
    m4 = m4 + 6.0 * shift**2 * (a * a * m2_b + b * b * m2_a) + 4.0 * shift * (a * m3_b - b * m3_a)
    return np.stack([mean, m2, m3, m4, np.minimum(low_a, low_b), np.maximum(high_a, high_b)], axis=1)


def statistic(name: str, field: Field, moments: Array, n: Array) -> tuple[Array, Array | None]:
    """Return a statistic and its one-sigma Monte-Carlo error, both (points, size), from moments (points, MOMENTS, size)
    of n (points,) realisations; extremes have no error.

    Where only two values occur the number of one of them is binomial; two of each are added (Agresti and Coull 1998),
    so that no error is 0.  Otherwise the errors of a mean and of a standard deviation are enlarged where the law is
    skewed or has tails: samples in which these are missing look too precise.  How much was found by simulation, of
    twelve laws from the uniform to the lognormal one.
    """
    count = n[:, None]
    mean, m2, m3, m4, low, high = (moments[:, k] for k in range(MOMENTS))
    if name in ("min", "max"):
        return (low if name == "min" else high), None
    if binary := field.type == "bool":
        low, high = np.zeros_like(mean), np.ones_like(mean)
    extent = high - low
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share = (mean - low) / extent
        likely = (share * count + 2.0) / (count + 4.0)
        of_share = np.sqrt(likely * (1.0 - likely) / count)
        if name == "count":
            return np.round(mean * count), of_share * count
        # m2 has its largest value, for this mean and these extremes, where nothing lies between them
        two_values = (m2 >= (1.0 - SAME) * count * (mean - low) * (high - mean)) | binary
        skewness = (m3 / m2) ** 2 / m2  # squared, over the number of realisations; cubes of m2 may overflow
        fewest = FEWEST_SAMPLES if name == "mean" else FEWEST_FOR_STD
        fits = (m4 >= np.finfo(float).tiny) & (m4 < np.inf)  # in double precision
        known = (extent > 0.0) & fits & (skewness <= ONE_DECIDES) & (count >= fewest) | binary
        variance = m2 / (count - 1.0)
        std = np.sqrt(variance)
        if name == "mean":
            value, of_two = mean, of_share
            error = enlarged_error(variance / count, count, skewness)
        else:
            value, of_two = std, _of_two_values(share, of_share, std / extent)
            error = std * _relative(moments, n)
        return value, np.where(known, np.where(two_values, extent * of_two, error), np.nan)


def _relative(moments: Array, n: Array) -> Array:
    """Return the relative error of the standard deviation of numbers, from the unbiased estimate of their kurtosis."""
    count = n[:, None]
    _, m2, m3, m4 = (moments[:, k] for k in range(4))
    factor = (count - 1.0) / ((count - 2.0) * (count - 3.0))
    kurtosis = np.maximum(factor * ((count + 1.0) * (count * (m4 / m2 / m2) - 3.0) + 6.0), -2.0)
    skewness = np.sqrt((m3 / m2) ** 2 / m2 * count**2 * (count - 1.0)) / (count - 2.0)
    plain = (kurtosis + 2.0 + 2.0 / (count - 1.0)) / (4.0 * count)
    # by simulation, so that samples in which the tails are missing do not look too precise
    enlarged = np.exp(np.clip((8.0 * kurtosis + 62.0 * skewness + 3.3 * kurtosis**2) / count, -0.5, 3.0))
    return np.sqrt(plain * enlarged)


def _of_two_values(share: Array, error: Array, std: Array) -> Array:
    """Return the error of the standard deviation of zeros and ones, from the interval of the share of ones."""
    ends = np.clip([share - SIGMAS * error, share + SIGMAS * error], 0.0, 1.0)
    spreads = np.sqrt(ends * (1.0 - ends))
    most = np.where((ends[0] < 0.5) & (ends[1] > 0.5), 0.5, spreads.max(axis=0))
    return np.asarray(np.hypot(most - std, std - spreads.min(axis=0)) / math.sqrt(2.0) / SIGMAS)


def quantiles(levels: Sequence[float], realisations: Array) -> Array:
    """Return quantiles of realisations (n, size) and their errors, (levels, 2, size).

    The number of realisations below the true quantile is binomial, whatever the law: so two of them are its limits.
    The error is NaN for fewer realisations than `fewest_for`, and where values repeat between the limits.
    """
    n = len(realisations)
    ordered = np.sort(realisations, axis=0)  # once for all levels
    pairs = np.full((len(levels), 2, realisations.shape[1]), np.nan)
    for i, level in enumerate(levels):
        pairs[i, 0] = np.quantile(ordered, level, axis=0, method="hazen")
        if n >= fewest_for(level):
            (first, lower), (last, upper) = _limit(ordered[::-1], 1.0 - level), _limit(ordered, level)
            between = ordered[n - 1 - first : last + 1]
            known = np.count_nonzero(np.diff(between, axis=0), axis=0) >= FEWEST_VALUES - 1
            above, below = upper - pairs[i, 0], pairs[i, 0] - lower
            larger, mean = np.maximum(above, below), np.hypot(above, below) / math.sqrt(2.0)
            # one error for both sides: the larger one only where they differ much, as where the law has a gap
            one_sigma = np.where(larger > 2.0 * np.minimum(above, below), larger, mean) / SIGMAS
            pairs[i, 1] = np.where(known, one_sigma, np.nan)
    return pairs


def fewest_for(level: float) -> int:
    """Return the fewest realisations that have some beyond both limits of a quantile.

    >>> fewest_for(0.5), fewest_for(0.95), fewest_for(0.999)
    (6, 74, 3782)
    """
    return math.ceil(math.log(TAIL) / math.log(max(level, 1.0 - level)))


def _limit(ordered: Array, level: float) -> tuple[int, Array]:
    """Return the upper limit of a quantile, between two order statistics, and the index of the second one.

    The position between them is that for a law that is uniform there (Nyblom 1992).
    """
    from scipy.special import bdtrc, bdtrik  # takes a tenth of a second, and most studies have no quantiles

    n = len(ordered)
    rank = math.ceil(bdtrik(1.0 - TAIL, n, level))
    at_least, more = bdtrc([rank - 1, rank], n, level)
    inside = (TAIL - more) / (at_least - more)
    below, above = (1.0 - inside) * level / rank, inside * (1.0 - level) / (n - rank)
    weight = below / (below + above)
    return rank, (1.0 - weight) * ordered[rank - 1] + weight * ordered[rank]


@dataclass(frozen=True)
class Moments(Reducer):
    """The reducer of realisations of a function: a row has their number and the moments of each output, and the row of
    a point besides the quantiles, with their errors, of the realisations that are kept.

    Attributes:
        layout: the results of one realisation.
        declared: the outputs that the function declares, with their statistics.
        keeps_all: whether all realisations are kept, not only those that quantiles need.
    """

    layout: Layout
    declared: tuple[Output, ...]
    keeps_all: bool = False

    @cached_property
    def statistics(self) -> dict[str, tuple[str, ...]]:
        """The statistics of each output, by its name."""
        declared = {output.name: tuple(dict.fromkeys(output.statistics)) for output in self.declared}
        return {field.name: declared.get(field.name) or DEFAULT for field in self.layout.fields}

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row."""
        moments: list[Any] = [(f.name, "<f8", (MOMENTS, self.size(f))) for f in self.layout.fields]
        levels = [(f, len(self.levels(f))) for f in self.layout.fields]
        quantiles: list[Any] = [(f.name, "<f8", (n, 2, self.size(f))) for f, n in levels if n]
        fields: list[Any] = [("n", "<f8"), ("moments", moments)]
        return np.dtype([*fields, ("quantiles", quantiles)] if quantiles else fields)

    @cached_property
    def samples_width(self) -> int:
        """The numbers of one realisation that are kept."""
        return sum(self.size(field) for field in self.layout.fields if self.keeps(field))

    def size(self, field: Field) -> int:
        """Return how many numbers an output has."""
        return math.prod(self.layout.shape(field))

    def levels(self, field: Field) -> list[float]:
        """Return the levels of the quantiles of an output, between 0 and 1."""
        return [level for name in self.statistics[field.name] if (level := quantile_of(name)) is not None]

    def keeps(self, field: Field) -> bool:
        """Return whether the realisations of an output are kept."""
        return self.keeps_all or bool(self.levels(field))

    def as_row(self, realisations: int, moments: Sequence[Array]) -> Any:
        """Return the fields of a row from the moments of all outputs, (MOMENTS, size) each."""
        row = (float(realisations), tuple(moments))
        if "quantiles" not in (self.dtype.names or ()):
            return row
        kind = self.dtype["quantiles"]
        return (*row, np.full(kind.itemsize // 8, np.nan).view(kind)[0])  # known when all blocks are there: `close`

    def add(self, total: Rows, block: Rows) -> Rows:
        """Return the moments of two sets of realisations as one."""
        if not total["n"].any():  # before the first block all is zero, which would be its least or largest value
            return block
        joined = block.copy()
        joined["n"] = total["n"] + block["n"]
        for name in self.statistics:
            mine, theirs = (rows["moments"][name] for rows in (total, block))
            joined["moments"][name] = merged(mine, total["n"], theirs, block["n"])
        return joined

    def close(self, total: Rows, samples: Array) -> Rows:
        """Return the row of a point with the quantiles of its realisations, (n, samples_width), and their errors."""
        closed, start = total.copy(), 0
        for field in self.layout.fields:
            size = self.size(field) if self.keeps(field) else 0
            if levels := self.levels(field):
                closed["quantiles"][field.name][0] = quantiles(levels, samples[:, start : start + size])
            start += size
        return closed

    def sample_outputs(self) -> tuple[Output, ...]:
        """Return the realisations of each output, where all are kept."""
        fields = self.layout.fields if self.keeps_all else ()
        about = ((field, f"realisations of {field.meaning or field.name.replace('_', ' ')}") for field in fields)
        return tuple(Output(f"{f.name}_samples", f.unit, meaning, f.dims, nan=True) for f, meaning in about)

    def outputs(self) -> tuple[Output, ...]:
        """Return the statistics of all outputs, each followed by its error."""
        headline = self.layout.headline(self.declared)
        made = []
        for field in self.layout.fields:
            meaning = field.meaning or field.name.replace("_", " ")
            plain = Output(field.name, dims=field.dims, headline=field.name in headline, nan=True)
            for name in self.statistics[field.name]:
                unit = "" if name == "count" else field.unit
                value = replace(plain, name=f"{field.name}_{name}", unit=unit, meaning=f"{_words(name)} of {meaning}")
                made.append(value)
                if name not in ("min", "max"):
                    error = f"one-sigma Monte-Carlo error of {value.name}"
                    if where := unknown(name, field):
                        error += f"; not known (NaN) {where}"
                    made.append(replace(value, name=f"{value.name}_mc_error", meaning=error, headline=False))
        return tuple(made)

    def finish(self, total: Rows, n: Array, n_cat: Array) -> dict[str, NDArray[Any]]:
        """Return all statistics and errors, (points, *shape)."""
        results: dict[str, NDArray[Any]] = {}
        for field in self.layout.fields:
            shape = (len(total), *self.layout.shape(field))
            for name in self.statistics[field.name]:
                if (level := quantile_of(name)) is None:
                    value, error = statistic(name, field, total["moments"][field.name], total["n"])
                else:
                    place = self.levels(field).index(level)
                    value, error = total["quantiles"][field.name][:, place].swapaxes(0, 1)
                results[f"{field.name}_{name}"] = value.reshape(shape)
                if error is not None:
                    results[f"{field.name}_{name}_mc_error"] = error.reshape(shape)
        return results


def drawn(outcomes: Sequence[Outcome], function: str, declared: tuple[Output, ...], keeps_all: bool) -> Outcome:
    """Return what the realisations of a block leave: their moments, with all of them or those that quantiles need.

    Raises ResultError where they differ in more than their values.
    """
    layout: Layout = outcomes[0].layout
    counted = {output.name for output in declared if "count" in output.statistics}
    if strange := [f for f in layout.fields if f.type != "bool" and (f.name in counted or f.type not in NUMBERS)]:
        name, kind = strange[0].name, strange[0].type
        made = "the statistic 'count' is of" if name in counted else "statistics are made of numbers and"
        raise ResultError(f"{function}: {name!r} is of type {kind}; {made} truth values")
    layout = layout.with_floats(field.name for field in layout.fields)
    rows = []
    for outcome in outcomes:
        if wrong := layout_differences(layout, outcome.layout):
            raise ResultError(f"{function}: one realisation differs from another: {'; '.join(wrong)}")
        rows.append(as_row(outcome, layout, function))
    columns = zip(*rows, strict=True)
    values = [np.array(column, dtype=float).reshape(len(rows), -1) for column in columns]
    reducer = Moments(layout, declared, keeps_all)
    kept = [array for field, array in zip(layout.fields, values, strict=True) if reducer.keeps(field)]
    row = reducer.as_row(len(rows), [moments_of(array) for array in values])
    return Outcome(row, np.concatenate(kept, axis=1) if kept else None, layout)
