"""Studies with more points: the union of those that a store holds and those that are asked for, which is what the store
shows; and what rounds of refinement have added, as a store records them.
"""

import json
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Experiment, Named, Parameter, Point, SweepError, Unknown, Value, refused, shown
from linksweep.sweep.formatting import counted
from linksweep.sweep.planning.grid import MAX_POINTS, NO_EFFECT, Grid, GridPoint, all_but
from linksweep.sweep.studies.points import MAX_VALUES, Values, is_empty, labels_of, numbers_like, require_distinct
from linksweep.sweep.studies.study import POINT, Conclusion, PointTable, Sampling, Study
from linksweep.sweep.tables.columns import sorted_json

# A grid of more points than this becomes a table where fewer than one in so many of its points are there, or where so
# many are not: the study names each of these.
SMALL, SPARSEST, MOST_LEFT_OUT = 1000, 10, 10_000

# The key in the origin of a table of points that was made of several studies: others may add rows to it.
UNITED = "united"

EARLIER = "with the points of other runs"

Row = tuple[Value, ...]
# The values at each place along a dimension, by its axes.
Rows = dict[tuple[str, ...], list[Row]]

# Of a study its grid, its constants, and the indices of its points with those that repeat them.
Side = tuple[Grid, Mapping[str, Value], NDArray[np.intp]]


def with_numbers_of(stored: Study, asked: Study) -> Study:
    """Return a study in which numbers that equal those of a store have their types: equal numbers are one point."""
    defaults, axes, fixed = stored.experiment.defaults(), dict(asked.axes), dict(asked.fixed)
    for name in (one.name for one in asked.experiment.parameters if one.kind == "any"):
        known = (defaults.get(name), stored.fixed.get(name), *stored.axes.get(name, ()))
        if name in axes:
            axes[name] = numbers_like(known, axes[name])
        elif name in fixed:
            (fixed[name],) = numbers_like(known, [fixed[name]])
    return replace(asked, axes=axes, fixed=fixed)


def united(stored: Study, asked: Study, in_ledger: Collection[bytes] = (), *, is_whole: bool = True) -> Study:
    """Return the study of all points that a store holds and that are asked for; ``asked`` itself where it has them all.

    Axes get the values of both; a constant that is another one, or an axis, in the other study becomes an axis.  Where
    that makes no grid, or a large one that is nearly empty, the points are a table; those of a grid that neither has
    are left out.  ``stored`` is the study of the store, ``in_ledger`` the digests of its points that are there: some
    of that study unless it ``is_whole``, and perhaps others.  Raises SweepError for values that cannot be on one axis,
    and for one name of two different values.
    """
    theirs, mine = Grid(stored), Grid(asked)
    defaults = asked.experiment.defaults()
    # an object that is a default is what the code has there now, as its points are known without it
    plain = {n: v for n, v in stored.experiment.defaults().items() if not isinstance(defaults.get(n), Named)}
    was, now = {**defaults, **plain, **stored.fixed}, {**defaults, **asked.fixed}
    defined = {(one.name, named.name): named for one in asked.experiment.parameters for named in one.defined}

    places = theirs.indices()
    if not is_whole:
        places = places[np.array([digest in in_ledger for digest in theirs.digests(places)], dtype=bool)]
    if not len(places):
        return asked
    kept = {name: np.unique(numbers) for name, numbers in theirs.places(theirs.repeated(places)).items()}
    there = [(axes, theirs.rows[name][number]) for name, axes in theirs.dimensions.items() for number in kept[name]]
    for name, value in [pair for axes, row in there for pair in zip(axes, row, strict=True)] + list(was.items()):
        if isinstance(value, Named) and defined.get((name, value.name), value) != value:
            words = "is another value than in the store, or its code has changed; give it another name"
            raise SweepError(f"{name}: {shown(value.name)} {words}")
    if gone := [name for name in stored.axes if name not in defaults]:
        raise SweepError(f"the axis {gone[0]} of the store is no parameter any more")
    idle = theirs.idle(places)
    alike = {*stored.axes, *asked.axes, *idle}
    changed = [name for name in defaults if name not in alike and sorted_json(was[name]) != sorted_json(now[name])]
    tables = [one.points for one in (asked, stored) if one.points is not None]
    excluded = tuple(clause for clause in asked.excluded if clause in stored.excluded)
    kept.pop(POINT, None)  # with rows that repeat others, and those that are not there yet
    rows = _crossed([(theirs, was, kept, idle), (mine, now, {}, mine.idle(mine.indices()))], changed)
    points = tables[0] if tables else None
    are_lost = any(one.labels and {*one.names} != {*tables[0].names} for one in tables)
    sides = (theirs, was, theirs.repeated(places)), (mine, now, mine.repeated(mine.indices()))
    repeat = _repeat(rows, () if points is None else points.names, *sides)
    both = len(places) + len(mine)
    is_sparse = math.prod(map(len, rows.values())) > max(SMALL, min(MAX_POINTS, SPARSEST * both, both + MOST_LEFT_OUT))
    axes, is_table = _columns(rows), are_lost or repeat or not _is_crossed(theirs, mine) or is_sparse
    if is_table or Grid(replace(asked, axes=axes, zipped=tuple(rows), points=points)).divided:
        names = tuple(dict.fromkeys([*stored.axes, *asked.axes, *changed]))
        old, new = (
            [tuple({**constants, **p.parameters}[name] for name in names) for p in grid.points(some)]
            for grid, constants, some in sides
        )
        rows, excluded, tables = {names: _joined(old, new)}, (), [PointTable(names)]
        if len(rows[names]) > MAX_VALUES:
            raise SweepError(f"the store and the study are together a table of more than {MAX_VALUES:,} points")
    axes = {n: _values(asked.experiment.parameter(n), some, bool(tables)) for n, some in _columns(rows).items()}
    if tables:
        columns = {name: axes[name] for name in tables[0].names}
        whole = [one.points for one in (asked, stored) if one.points in tables and columns.items() <= one.axes.items()]
        labels = _labels(columns, *sides)
        points = PointTable(tables[0].names, whole[0].origin if whole else {UNITED: True}, labels)
    result = replace(
        asked,
        experiment=_experiment(stored, asked, axes),
        axes=axes,
        fixed={name: value for name, value in asked.fixed.items() if name not in axes},
        sampling=_sampling(stored, asked),
        zipped=tuple(names for names in rows if len(names) > 1 and (points is None or {*names} != {*points.names})),
        points=points,
        excluded=excluded,
        counts={},
    )
    result = replace(result, counts=_counts(theirs, places, mine, result, in_ledger))
    is_same = result.digest() == asked.digest()
    if is_same and [*result.dimensions] == [*asked.dimensions]:
        return asked
    overrides = asked.overrides if is_same or EARLIER in asked.overrides else (*asked.overrides, EARLIER)
    conclusion = asked.conclusion if axes.keys() == asked.axes.keys() else None
    return replace(result, overrides=overrides, conclusion=conclusion, sections=_sections(stored, asked, conclusion))


def _repeat(rows: Rows, table: tuple[str, ...], *sides: Side) -> bool:
    """Return whether values of an axis repeat, or rows of a ``table`` repeat or have other labels along more places of
    other axes than in a grid that has them.
    """
    others = {names: some for names, some in rows.items() if names != table}
    along = math.prod(map(len, others.values()))
    distinct = [[(value,) for value in column] for column in _columns(others).values()]
    narrow = [one.rows[POINT] for one, *_ in sides if len(one) < along * len(one.rows.get(POINT, ()))]
    is_repeated = any(turn for some in (*distinct, *narrow) for _, turn in _keys(some))
    return is_repeated or (bool(narrow) and _are_relabelled(table, *sides))


def _columns(rows: Rows) -> dict[str, tuple[Value, ...]]:
    """Return the values along the dimension of each axis."""
    return {n: column for names, some in rows.items() for n, column in zip(names, zip(*some, strict=True), strict=True)}


def _values(parameter: Parameter, column: Sequence[Value], is_table: bool) -> tuple[Value, ...]:
    """Return the values of an axis, of equal ones those that its parameter has, which can be computed with; raises
    SweepError for values that cannot be on one axis.
    """
    known = {value: value for value in (parameter.default, *parameter.defined)}
    values = tuple(known.get(value, value) if isinstance(value, Named) else value for value in column)
    with refused(ValueError, said=f"{parameter.name}, with its values in the store: "):
        plain = {(type(value), value): value for value in column if not isinstance(value, Named)}
        if changed := [one for (kind, _), one in plain.items() if type(parameter.parse(one)) is not kind]:
            raise ValueError(f"{changed[0]!r} would be {parameter.parse(changed[0])!r}")
        require_distinct(values, is_table)
        Values.require_labels(values)
    return values


def _labels(columns: Mapping[str, Sequence[Value]], *sides: Side) -> dict[str, list[Any]]:
    """Return the labels of the rows of a table: those of the last study of which it is a row."""
    names = dict.fromkeys(name for grid, *_ in sides if grid.study.points for name in grid.study.points.labels)
    labels = defaultdict[tuple[str, int], dict[str, Any]](dict)
    for side in sides if names else ():
        for key, cells in _labels_by_row([*columns], *side).items():
            labels[key].update(cells)
    rows = [labels[key] for key in _keys(zip(*columns.values(), strict=True))]
    return {name: labels_of([cells.get(name) for cells in rows]) for name in names}


def _is_blank(cell: object) -> bool:
    return is_empty(cell) or cell == ""


def _labels_by_row(
    names: Sequence[str], grid: Grid, constants: Mapping[str, Value], places: NDArray[np.intp]
) -> dict[tuple[str, int], dict[str, Any]]:
    """Return the labels of the rows of a study by name, none without a table: the rows are the values of some
    parameters in its table, or at its points.  A row without a label of a table that was united may be of no table.
    """
    points = grid.study.points
    if points is not None and {*names} <= {*points.names}:  # also rows without points, as yet
        rows = [*zip(*(grid.study.axes[name] for name in names), strict=True)]
        along: Sequence[int] = range(len(rows))
    else:
        rows = [tuple({**constants, **p.parameters}[name] for name in names) for p in grid.points(places)]
        along = grid.places(places)[POINT] if points else places.tolist()
    labels, may_lack = (points.labels.items(), UNITED in points.origin) if points else ((), False)
    return {
        key: {name: cells[k] for name, cells in labels if not (may_lack and _is_blank(cells[k]))}
        for key, k in zip(_keys(rows), along, strict=True)
    }


def _are_relabelled(names: Sequence[str], *sides: Side) -> bool:
    """Return whether a row has other labels in one of two studies than in the other."""
    one, other = (
        {key: {n: str(cell) for n, cell in cells.items() if not _is_blank(cell)} for key, cells in some.items()}
        for some in (_labels_by_row(names, *side) for side in sides)
    )
    return any(one[key] != other[key] for key in one.keys() & other.keys())


def _keys(rows: Iterable[Row]) -> list[tuple[str, int]]:
    """Return what tells rows apart: their values, and how many before have the same."""
    seen = defaultdict[str, Iterator[int]](count)
    return [(key, next(seen[key])) for key in (sorted_json(list(row)) for row in rows)]


def _is_crossed(theirs: Grid, mine: Grid) -> bool:
    """Return whether axes that share a dimension in one of two grids do so in both, or are constants in the other."""
    both = (theirs, mine)
    one, other = ({(frozenset(axes), name == POINT) for name, axes in grid.dimensions.items()} for grid in both)
    alone = all(axes.isdisjoint(mine.study.axes) for axes, _ in one - other)
    return alone and all(axes.isdisjoint(theirs.study.axes) for axes, _ in other - one)


def _crossed(
    sides: Sequence[tuple[Grid, Mapping[str, Value], Mapping[str, NDArray[np.intp]], set[str]]], changed: Sequence[str]
) -> Rows:
    """Return the values along each dimension of a store and a study, and of constants that have ``changed``; of each
    its grid, its constants, which places along its dimensions are kept, all if that does not say, and the parameters
    whose values are not needed.
    """
    rows: Rows = {}
    for names in (*(axes for grid, *_ in sides for axes in grid.dimensions.values()), *((name,) for name in changed)):
        if any(names[0] in known for known in rows):
            continue
        both = list[list[Row]]()
        for grid, constants, kept, idle in sides:
            dimension = next((d for d, axes in grid.dimensions.items() if names[0] in axes), None)
            if dimension is None:
                both.append([] if idle.issuperset(names) else [tuple(constants[name] for name in names)])
            else:
                there = [dict(zip(grid.dimensions[dimension], row, strict=True)) for row in grid.rows[dimension]]
                some = [there[number] for number in kept[dimension]] if dimension in kept else there
                both.append([tuple(row.get(name) for name in names) for row in some if NO_EFFECT not in row.values()])
        rows[names] = _joined(*both) or [tuple(sides[-1][1][name] for name in names)]
    return rows


def _joined(old: list[Row], new: list[Row]) -> list[Row]:
    """Return the rows of both: those of one that has all in its order, else in ascending order if they are numbers."""
    known, keys = {*_keys(old)}, _keys(new)
    if known.issubset(keys):
        return new
    added = [row for row, key in zip(new, keys, strict=True) if key not in known]
    joined = [*old, *added]
    if added and all(len(row) == 1 and type(row[0]) in (int, float) for row in joined):
        joined.sort()
    return joined


def _experiment(stored: Study, asked: Study, columns: Mapping[str, Sequence[Value]]) -> Experiment:
    """Return the experiment with the named values of both; the store has no more of its own than their identity."""
    defined: dict[str, tuple[Named, ...]] = {}
    for parameter in asked.experiment.parameters:
        values = (*parameter.defined, *columns.get(parameter.name, ()))
        defined[parameter.name] = tuple({one.name: one for one in values if isinstance(one, Named)}.values())
    experiment = asked.experiment.with_setting("defined", defined)
    if experiment.parameters == asked.experiment.parameters:
        return asked.experiment
    present, recorded = experiment.cost, stored.experiment.cost

    def cost(point: Point) -> float:
        is_known = not any(isinstance(value, Named) and value.value is Unknown for value in point.values())
        return present(point) if is_known else recorded(point)

    return replace(experiment, cost=cost if experiment.says_cost else present)


def _sampling(stored: Study, asked: Study) -> Sampling:
    """Return the sampling that is enough for a store and for what is asked, that of the store where this is."""
    old, new = stored.sampling, asked.sampling
    more: dict[str, Any] = {"n_sim": max(old.n_sim, new.n_sim), "n_cat": max(old.n_cat, new.n_cat)}
    if precise := [one for one in (old, new) if one.precision is not None]:
        more["precision"] = min(one.precision or 1.0 for one in precise)
        more["max_n_sim"] = max(more["n_sim"], *(one.most for one in precise))
    both = new.model_copy(update=more)
    wanted = both.n_sim, both.n_cat, both.precision, both.most
    return next((one for one in (old, new) if (one.n_sim, one.n_cat, one.precision, one.most) == wanted), both)


def _counts(
    theirs: Grid, places: NDArray[np.intp], mine: Grid, whole: Study, in_ledger: Collection[bytes]
) -> dict[str, int]:
    """Return the realisations of single points of two studies, the larger ones; none of points of their union that
    neither has.
    """
    both = [*theirs.study.counts.items(), *mine.study.counts.items()]
    counts = {name: n for name, n in sorted(both, key=lambda one: one[1]) if n}
    if len(Grid(whole).indices()) in (len(places), len(mine.indices())):  # which one of them has all
        return counts
    return counts | all_but(whole, {*theirs.digests(places), *mine.digests(mine.indices()), *in_ledger})


def _sections(stored: Study, asked: Study, conclusion: Conclusion | None) -> dict[str, Any]:
    """Return the sections of the union: what both define, and no conclusion that is about other axes."""
    theirs, mine = (one.sections.get("define", {}) for one in (stored, asked))
    define = {name: {**theirs.get(name, {}), **mine.get(name, {})} for name in {**theirs, **mine}}
    sections = {**asked.sections, **({"define": define} if define else {})}
    return {key: section for key, section in sections.items() if conclusion or key != "conclusion"}


# The attribute of a store with the rounds that have refined its study, as JSON.
REFINED = "refined"


@dataclass(frozen=True)
class Round:
    """What one round adds, and what it is ``wanted`` for: ``points``, each by its values on all axes, of which that
    ``along`` one may be new; and a larger ``n_sim`` of single points by their digests.
    """

    wanted: str
    along: str
    points: list[dict[str, Any]]
    n_sim: dict[str, int]

    def __str__(self) -> str:
        new = [counted(len(self.points), "new point")] if self.points else []
        more = [f"more realisations of {counted(len(self.n_sim), 'point')}"] if self.n_sim else []
        return f"{', '.join([*new, *more])} for {self.wanted}"


def rounds_of(*stores: Mapping[str, Any]) -> list[Round]:
    """Return the rounds that stores with these attributes record, each once."""
    recorded = [Round(**one) for attributes in stores for one in json.loads(attributes.get(REFINED, "[]"))]
    return [one for number, one in enumerate(recorded) if one not in recorded[:number]]


def refined(study: Study, rounds: Iterable[Round]) -> Study:
    """Return a study with what some rounds add: of the grown grid their points alone.

    Points on other axes than the study has, or beside its values on them, are left out.
    """
    parameters, axes = {name: study.experiment.parameter(name) for name in study.axes}, dict(study.axes)
    counts, added = dict(study.counts), set[bytes]()
    for one in rounds:
        for raw in one.points if all(point.keys() == axes.keys() for point in one.points) else ():
            point = {name: parameters[name].parse(value) for name, value in raw.items()}
            if all(value in (None, *axes[name]) for name, value in point.items() if name != one.along):
                axes[one.along] = tuple(dict.fromkeys([*axes[one.along], point[one.along]]))
                added.add(point_at(study, point).digest)
        counts |= {name: max(n, counts.get(name, 0)) for name, n in one.n_sim.items()}
    grown = [name for name, values in study.axes.items() if len(axes[name]) > len(values)]
    axes |= {name: tuple(sorted(axes[name], key=lambda value: (value is None, value or 0))) for name in grown}
    grid = Grid(study)
    counts |= all_but(replace(study, axes=axes), {*added, *grid.digests(grid.indices())})
    return replace(study, axes=axes, counts=counts)


def point_at(study: Study, values: Mapping[str, Value]) -> GridPoint:
    """Return the point of a study with some values on its axes, which need not have them."""
    return Grid(replace(study, axes={n: (values[n],) for n in study.axes}, zipped=(), points=None, counts={})).point(0)
