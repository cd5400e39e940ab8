"""The labelled dataset of a study, from what blocks left, and covariances of points that share random numbers."""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import accumulate, groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import FEWEST_SAMPLES, Array, Output, Parameter, Rows, Status, Sums
from linksweep.sweep.contract.rows import LENGTH, MISSING_INT, REFERENCE, Block, Reducer, absent, ledger_key
from linksweep.sweep.formatting import ERRORS, RAGGED, TRUTH, described, short_meaning
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import NO_EFFECT, Grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.stores.ledger import Stored
from linksweep.sweep.stores.location import Location
from linksweep.sweep.stores.store import FILL, RUNNING, Store, dask_arrays_only_where_imported, finished, with_gaps
from linksweep.sweep.studies.study import POINT, printed_rounding

if TYPE_CHECKING:
    import xarray as xr


@dataclass
class Variable:
    """An array with the names of its dimensions and what is to be said about it; a large one is `Stored`, and
    its values are read each time.
    """

    dims: tuple[str, ...]
    data: NDArray[Any] | Stored
    attrs: dict[str, Any] = field(default_factory=dict)
    encoding: dict[str, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        """Return what the data know: dtype, shape, size."""
        return getattr(self.data, name)

    @property
    def values(self) -> NDArray[Any]:
        """The values in memory."""
        return np.asarray(self.data)

    def copy(self, data: NDArray[Any]) -> "Variable":
        """Return an array with other values."""
        return replace(self, data=data, attrs=dict(self.attrs))

    def transpose(self, *dims: str) -> "Variable":
        """Return the array with its dimensions in another order."""
        return replace(self, dims=dims, data=self.values.transpose([self.dims.index(dim) for dim in dims]))


@dataclass
class Labelled:
    """The results of a study, with the parts and the names that they have in xarray.

    Who only writes them or prints a table and an answer needs no more: importing xarray, and pandas with it, takes
    longer than all the rest of a small run.
    """

    data_vars: dict[str, Variable]
    coords: dict[str, Variable]
    attrs: dict[str, Any] = field(default_factory=dict)

    @property
    def variables(self) -> dict[str, Variable]:
        """All arrays by name."""
        return self.data_vars | self.coords

    @property
    def sizes(self) -> dict[str, int]:
        """The length of each dimension."""
        return {d: n for one in self.variables.values() for d, n in zip(one.dims, one.shape, strict=True)}

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def __getitem__(self, name: str) -> Variable:
        return self.variables[name] if name in self else Variable((name,), np.arange(self.sizes[name]))

    def assign(self, variables: Mapping[str, Variable]) -> "Labelled":
        """Return the results with more variables, or others in their place."""
        return replace(self, data_vars={**self.data_vars, **variables})

    def drop_vars(self, names: Collection[str]) -> "Labelled":
        """Return the results without some variables."""
        return replace(self, data_vars={n: one for n, one in self.data_vars.items() if n not in names})

    def map(self, function: Callable[[Variable], Variable]) -> "Labelled":
        """Return the results with what a function makes of each array."""
        data_vars, coords = ({n: function(one) for n, one in some.items()} for some in (self.data_vars, self.coords))
        return Labelled(data_vars, coords, self.attrs)

    def isel(self, place: Mapping[str, int] | Mapping[str, slice]) -> "Labelled":
        """Return the part at an index along some dimensions, which these then lack, or at a slice."""

        def part(one: Variable) -> Variable:
            index = tuple(place.get(dim, slice(None)) for dim in one.dims)
            dims = tuple(dim for dim, at in zip(one.dims, index, strict=True) if isinstance(at, slice))
            return replace(one, dims=dims, data=np.asarray(one.data[index])) if {*place} & {*one.dims} else one

        return self.map(part)

    def to_xarray(self) -> "xr.Dataset":
        """Return the dataset that xarray has of them."""
        import xarray as xr

        dask_arrays_only_where_imported()

        def plain(one: Variable) -> tuple[Any, ...]:
            data = one.data.to_xarray() if isinstance(one.data, Stored) else one.data
            if data.dtype.kind in "OU" and FILL not in one.encoding:  # as a store has texts
                data = data.astype(np.dtypes.StringDType())
            return one.dims, data, one.attrs, one.encoding

        data_vars, coords = ({n: plain(one) for n, one in part.items()} for part in (self.data_vars, self.coords))
        return xr.Dataset(data_vars, coords, self.attrs)


def assemble(plan: Plan, accumulator: Accumulator, location: Location) -> Labelled:
    """Return the dataset of a plan from what its accumulator holds, as it is stored; large arrays are read from the
    store at the ``location`` as they are used.

    A point has values when all its blocks are there; all others are missing (`missing_of`) with a ``status`` that says
    why.  Missing integers have the number that the encoding names as ``_FillValue``; `masked` has NaN in place of it.
    What points that are begun have so far is in variables of its own, which `with_running` puts in place.
    """
    grid = plan.grid
    study = grid.study
    experiment = study.experiment
    status, realisations = grid.with_repeats(accumulator.status), grid.with_repeats(accumulator.realisations)
    done = status == Status.DONE
    variables, large = dict[str, Variable](), experiment.large()
    results: Mapping[str, NDArray[Any]] = {}
    ragged = experiment.ragged()
    if done.any():
        total, n = grid.with_repeats(accumulator.total)[done], realisations[done].astype(float)
        results = accumulator.reducer.finish(total, n, np.full(len(n), float(study.sampling.n_cat)))
    # Of a function whose points have all failed, it depends on time, and on parts, whether a block told the outputs.
    is_unknown = experiment.as_record() and np.isin(status, (Status.FAILED, Status.EXCLUDED)).all()
    for output in () if is_unknown else experiment.outputs:
        if output.name in study.axes:
            continue  # the coordinate of that name has these values already
        shape, within = experiment.shape_of(output), None
        if output.name in ragged and output.name in results:
            places = np.indices(shape)[output.dims.index(ragged[output.name])]
            within = places < results[output.name + LENGTH].reshape(-1, *[1] * len(shape))
        if output.name in large:
            chunks = np.where(done[:, None], grid.with_repeats(accumulator.total)[output.name], np.zeros(1, REFERENCE))
            chunks = chunks.reshape(*grid.shape, -1)
            values: Any = Stored(location, chunks, (*grid.shape, *shape), large[output.name])
            missing = absent(values.dtype)
        else:
            values, missing = typed_array(results.get(output.name), done, shape, within)
        variables[output.name] = _variable(grid, values, output)
        if output.name in results and results[output.name].dtype.kind == "b" and values.dtype.kind == "f":
            variables[output.name].attrs.update(TRUTH)
        if values.dtype.kind == "i" and (output.name in ragged or not done.all()):
            variables[output.name].encoding[FILL] = missing
    if not experiment.deterministic:
        over = f", over all {experiment.outer_draw}s" if experiment.outer_draw else ""
        meaning = f"realisations done{over}"
        # How far others of its task came before a point failed depends on time.
        counted = np.where(status == Status.FAILED, 0, realisations)
        variables["n_sim_done"] = _variable(grid, counted, Output("n_sim_done", "", meaning))
    took = np.where(done, grid.with_repeats(accumulator.seconds), np.nan)
    variables["wall_time"] = _variable(grid, took, Output("wall_time", "s", "wall time of all blocks of the point"))
    variables["status"] = _variable(grid, status.copy(), Output("status", "", "state of the point"))
    stored = [s for s in Status if s != Status.RUNNING]
    variables["status"].attrs.update(flag_values=list(map(int, stored)), flag_meanings=" ".join(s.word for s in stored))
    variables |= _published(grid) | _so_far(plan, accumulator)
    longest: dict[str, int] = {}
    for name, dimension in ragged.items():
        variables[name].attrs[RAGGED] = dimension
        longest[dimension] = max(longest.get(dimension, 1), int(np.max(results.get(name + LENGTH, 1))))
    columns = study.published.rows[0] if study.published is not None and not experiment.undeclared else ()
    lost = [c for c in columns if c not in experiment.defaults() and f"{c}_published" not in variables]
    whole = Labelled(variables, _coordinates(grid), {"published_not_compared": json.dumps(lost)} if lost else {})
    return whole.isel({dimension: slice(length) for dimension, length in longest.items()})


def _so_far(plan: Plan, accumulator: Accumulator) -> dict[str, Variable]:
    """Return ``NAME(running)`` of each result, and of the realisations that it is from, at points that are begun.

    An error is NaN where it needs more catalogues than there are yet; nothing is returned where an experiment cannot
    make results of less than all realisations.
    """
    so_far, grid, experiment = accumulator.so_far(), plan.grid, plan.grid.study.experiment
    if not so_far:
        return {}
    rows, n, n_cat = (np.array(column) for column in zip(*so_far.values(), strict=True))
    try:
        results = dict(accumulator.reducer.finish(rows.reshape(-1), n.astype(float), n_cat.astype(float)))
    except Exception:  # whatever a user's function raises
        return {}
    there, few = np.array([*so_far]), n_cat < min(FEWEST_SAMPLES, grid.study.sampling.n_cat)
    outputs = {output.name: output for output in experiment.outputs if output.name not in grid.study.axes}
    errors = {error for output in outputs.values() for error in output.errors}
    variables = {}
    for name, output in outputs.items():
        values = np.full((len(grid), *experiment.shape_of(output)), np.nan)
        values[there] = results[name]
        if name in errors or name.endswith(("_mc_error", "_catalogue_error")):
            values[there[few]] = np.nan
        variables[f"{name}{RUNNING}"] = _variable(grid, values, output)
    done = np.zeros(len(grid), dtype=np.int64)
    done[there] = n
    meaning = "realisations in what there is so far"
    variables[f"n_sim_done{RUNNING}"] = _variable(grid, done, Output("n_sim_done", "", meaning))
    return variables


def missing_of(results: NDArray[Any] | None) -> Any:
    """Return what is in place of missing results: NaT beside times, empty beside texts, NaN beside other results, but
    beside integers the smallest one that is none of them, nor like one as a float: xarray compares it with floats.
    """
    if results is None or results.dtype.kind != "i":
        return {"O": "", "M": np.datetime64("NaT", "ns")}.get("f" if results is None else results.dtype.kind, np.nan)
    floats, fill = results.astype(float), MISSING_INT
    while (floats == fill).any():
        fill += 1024  # the step between floats of that size
    return fill


def typed_array(
    results: NDArray[Any] | None,
    done: NDArray[np.bool_],
    shape: tuple[int, ...] = (),
    within: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[Any], Any]:
    """Return an array (points, *shape) with the results (done points, *shape) at the points that are done, where they
    are ``within`` their lengths, and what is in place of missing ones elsewhere; truth values become floats then.
    """
    missing = missing_of(results)
    if results is None:
        return np.full((len(done), *shape), missing), missing
    if done.all() and within is None:
        return np.array(results.reshape(len(done), *shape)), missing
    values = np.full((len(done), *shape), missing, dtype=float if results.dtype.kind == "b" else results.dtype)
    values[done] = results if within is None else np.where(within, results, missing)
    return values, missing


def masked(dataset: Labelled) -> Labelled:
    """Return a dataset as who opens its store has it: integers of which some are missing have NaN there, and nothing is
    of points that are not done.
    """
    done: Labelled = finished(dataset)
    return done.map(lambda one: one.copy(with_gaps(one.values, one.encoding[FILL])) if FILL in one.encoding else one)


def assemble_samples(plan: Plan, status: NDArray[np.int8], samples: Callable[[bytes], Array]) -> dict[str, Variable]:
    """Return the kept samples of the points that are done, with dimension ``sample``: catalogue by catalogue.

    ``samples`` gives those of a block by its key, (realisations, width).
    """
    grid = plan.grid
    experiment, sampling = grid.study.experiment, grid.study.sampling
    kept = np.full((len(grid), sampling.n_cat, sampling.n_sim, experiment.samples_width), np.nan)
    for point in grid.points(np.flatnonzero(status == Status.DONE)):
        cost = plan.cost(point.parameters)
        for block in plan.blocks(cost):
            first = plan.realisations(cost, block.part)
            catalogues = slice(block.first_catalogue, block.first_catalogue + block.n_cat)
            drawn = samples(ledger_key(point.digest, block)).reshape(block.n_cat, block.n_sim, -1)
            kept[point.index, catalogues, first : first + block.n_sim] = drawn
    kept = grid.with_repeats(kept)
    variables: dict[str, Variable] = {}
    column = 0
    for output in experiment.sample_outputs:
        size = experiment.size_of(output)
        shape = (*grid.shape, sampling.n_cat * sampling.n_sim, *experiment.shape_of(output))
        values = kept[..., column : column + size].reshape(shape)
        variables[output.name] = Variable((*grid.dimensions, "sample", *output.dims), values, _attributes(output))
        column += size
    return variables


def code_variable(plan: Plan, accumulator: Accumulator, numbers: Mapping[bytes, int]) -> Variable:
    """Return which code made each point, from the ``numbers`` of what made each block, by its key in the ledger."""
    codes = np.zeros(len(plan.grid), dtype=np.int32)
    n_cat = plan.grid.study.sampling.n_cat
    for point in plan.grid.points():
        if accumulator.status[point.index] == Status.DONE:
            cost = plan.cost(point.parameters)
            parts = range(plan.parts(cost, int(accumulator.realisations[point.index]) // n_cat))
            made_by = {numbers[ledger_key(point.digest, one)] for one in plan.blocks(cost, parts)}
            codes[point.index] = made_by.pop() if len(made_by) == 1 else -1
    meaning = "code that made the point: its place, from 1, in the attribute code; 0 none, -1 several"
    return _variable(plan.grid, codes, Output("code", "", meaning))


def _variable(grid: Grid, values: Any, output: Output) -> Variable:
    attributes = _attributes(output)
    if output.headline:
        attributes["headline"] = 1
    if output.errors:
        attributes[ERRORS] = " ".join(output.errors)
    if values.dtype.kind == "M":
        attributes.pop("units", None)  # xarray has its own for times
    if not isinstance(values, Stored):
        values = grid.with_repeats(values).reshape((*grid.shape, *values.shape[1:]))
    return Variable((*grid.dimensions, *output.dims), values, attributes)


def _attributes(declared: Output | Parameter) -> dict[str, Any]:
    symbol = {"symbol": declared.symbol} if declared.symbol else {}
    if isinstance(declared, Parameter) and declared.symbols:
        symbol["symbols"] = json.dumps(dict(declared.symbols))
    return described(declared.unit, declared.meaning) | symbol


def _coordinates(grid: Grid) -> dict[str, Variable]:
    study = grid.study
    experiment = study.experiment
    coordinates: dict[str, Variable] = {}
    if study.points is not None:
        coordinates[POINT] = Variable((POINT,), np.arange(grid.shape[0]), described("", "number of the point"))
        for name, cells in study.points.labels.items():
            texts = np.array(cells, dtype=object if isinstance(cells[0], str) else None)
            coordinates[name] = Variable((POINT,), texts, described("", "label of the point"))
    for dimension, axes in grid.dimensions.items():
        for name, along in zip(axes, zip(*grid.rows[dimension], strict=True), strict=True):
            parameter = experiment.parameter(name)
            has_own_place = name in study.alone or name not in study.when
            there = np.array([one is not NO_EFFECT for one in along]) if has_own_place else grid.without(name) != 1.0
            known = [value for value, is_there in zip(along, there, strict=True) if is_there]
            kinds = set(map(type, known))
            is_text = parameter.kind == "str" or not (kinds <= {int, float} or kinds == {bool})
            array = np.array(list(map(str, known)) if is_text else known, dtype=object if is_text else None)
            data, fill = typed_array(array, there)
            gaps = {FILL: fill} if data.dtype.kind == "i" and not there.all() else {}
            coordinates[name] = Variable((dimension,), data, _attributes(parameter), gaps)
    for dimension, (values, unit, meaning) in experiment.dimension_coordinates().items():
        about = described(unit, meaning or dimension.replace("_", " "))
        coordinates.setdefault(dimension, Variable((dimension,), np.asarray(values), about))
    for dimension, units in experiment.component_units.items():
        about = described("", f"unit of each {dimension.replace('_', ' ')}")
        coordinates[f"{dimension}_unit"] = Variable((dimension,), np.array(units, dtype=object), about)
    return coordinates


def _published(grid: Grid) -> dict[str, Variable]:
    """Return ``NAME_published`` and ``NAME_published_rounding`` of each output with a column of published numbers."""
    study = grid.study
    if study.published is None:
        return {}
    outputs = {o.name: o for o in study.experiment.outputs if o.name not in study.axes and not o.dims}
    origin, rows = study.published.about.model_dump(exclude={"file", "where"}, exclude_none=True), study.published.rows
    named = [name for name in study.experiment.defaults() if name in rows[0] and name not in outputs]
    where = {**study.experiment.defaults(), **study.published.where}
    lacking = [n for n, some in study.axes.items() if n not in rows[0] and len(set(map(_as_printed, some))) > 1]
    here = {n: {_as_printed(where[n]), _as_printed(None if n in study.when else where[n])} for n in lacking}
    origin |= {"without_column": ", ".join(here)} if here else {}
    there = defaultdict[tuple[float | str, ...], list[int]](list)
    for index, parameters in Grid(replace(study, excluded=())).parameters():
        if all(_as_printed(parameters[name]) in some for name, some in here.items()):
            there[tuple(_as_printed(parameters[name]) for name in named)].append(index)
    known = [{values[k] for values in there} for k in range(len(named))]
    at = [
        there.get(tuple(_as_read(row[name], some) for name, some in zip(named, known, strict=True)), ()) for row in rows
    ]
    variables: dict[str, Variable] = {}
    for column in (name for name in rows[0] if name in outputs):
        output, printed = outputs[column], [(places, row[column]) for places, row in zip(at, rows, strict=True)]
        inside = [(places[0], text) for places, text in printed if text and len(places) == 1]
        values, roundings = np.full(len(grid), np.nan), np.full(len(grid), np.nan)
        for index, text in inside:
            values[index], roundings[index] = float(text), printed_rounding(text)
        name, rounding = f"{column}_published", f"{column}_published_rounding"
        meaning = f"published {short_meaning(output.meaning) or output.name}"
        variables[name] = _variable(grid, values, Output(name, output.unit, meaning))
        outside = sum(bool(text) for _, text in printed) - len(inside)
        variables[name].attrs.update(origin, outside_grid=outside)
        meaning = f"half a unit of the last printed digit of {name}"
        variables[rounding] = _variable(grid, roundings, Output(rounding, output.unit, meaning))
    return variables


def _as_printed(value: object) -> float | str:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def _as_read(text: str, known: Set[float | str]) -> float | str:
    """Return the number that a text is, or the text itself where that is a value of the parameter."""
    try:
        return text if text in known else float(text)
    except ValueError:
        return text.title() if text.lower() in ("true", "false") else text


# Most elements of one covariance, which has one for every pair of points along an axis, and of its samples.
LARGEST = 10**7


def add_covariances(dataset: Labelled, plan: Plan, accumulator: Accumulator, store: Store) -> Labelled:
    """Return a dataset with ``NAME_mc_covariance_AXIS`` of every result with a Monte-Carlo error, for every axis along
    which points share their random numbers; dimensions of the result and ``AXIS_other``, which has the values of AXIS.

    The independent samples are the catalogues, each with all its blocks, or the blocks where there is one catalogue.
    The results without each of them in turn give the covariance (Efron 1982, The Jackknife, Sect. 3.5 and 6.1).  It has
    all correlated errors: those of realisations, and those of catalogues if there are several.  The attribute
    ``samples`` says how many samples all points have; with fewer than `FEWEST_SAMPLES` there is no covariance.
    """
    grid, experiment, n_sim = plan.grid, plan.grid.study.experiment, plan.grid.study.sampling.n_sim
    longest = int(accumulator.realisations.max()) // plan.grid.study.sampling.n_cat
    samples, most = (len(_independent(plan, n)) for n in (n_sim, longest))
    if samples < FEWEST_SAMPLES:
        return dataset
    lengths = dict(zip(grid.dimensions, grid.shape, strict=True))
    shared = [dimension for dimension, axes in grid.dimensions.items() if {*axes} <= {*experiment.shared}]
    outputs = {output.name: output for output in experiment.outputs}
    with_error = [o for o in outputs.values() if f"{o.name}_mc_error" in outputs and o.name not in grid.study.axes]
    size = {o: len(grid) * experiment.size_of(o) for o in with_error}
    wanted = [(o, d) for o in with_error for d in shared if size[o] * max(lengths[d], most) <= LARGEST]
    deviations = _deviations(plan, accumulator, most, [o for o, _ in wanted], store) if wanted else {}
    made = {
        f"{output.name}_mc_covariance_{dimension}": _covariance(plan, deviations, output, dimension, samples)
        for output, dimension in wanted
        if not np.isnan(deviations[output.name]).all()  # as of quantiles, which no sum gives
    }
    others = {one.dims[-1]: replace(dataset.coords[one.dims[-2]], dims=one.dims[-1:]) for one in made.values()}
    return replace(dataset.assign(made), coords=dataset.coords | others)


def _independent(plan: Plan, n_sim: int) -> list[list[Block]]:
    """Return the blocks of each sample of a point with ``n_sim`` realisations of each catalogue: points that share
    random numbers have the same blocks whatever they cost.

    Where there is one catalogue, each of its blocks is a sample, except one that is smaller.
    """
    blocks = plan.blocks(1.0, range(plan.parts(1.0, n_sim)))
    if plan.grid.study.sampling.n_cat == 1:
        return [[block] for block in blocks if block.n_sim == blocks[0].n_sim]
    return [list(group) for _, group in groupby(blocks, key=lambda block: block.group)]


def _deviations(
    plan: Plan, accumulator: Accumulator, most: int, outputs: Sequence[Output], store: Store
) -> dict[str, Array]:
    """Return each result without each of its samples in turn, less the mean, scaled so that products add up to the
    covariance; (points, size of the result, most samples), NaN for points that are not done, and 0 for a sample that
    only others have.
    """
    grid, rows, ledger = plan.grid, store.rows, store.read()
    experiment, n_cat, reducer = grid.study.experiment, grid.study.sampling.n_cat, accumulator.reducer
    deviations = {o.name: np.full((len(grid), experiment.size_of(o), most), np.nan) for o in outputs}
    for point in grid.points(np.flatnonzero(accumulator.status == Status.DONE)):
        n, total = float(accumulator.realisations[point.index]), accumulator.total[point.index : point.index + 1]
        n_sim = int(n) // n_cat
        samples, blocks = _independent(plan, n_sim), plan.blocks(1.0, range(plan.parts(1.0, n_sim)))
        count, alone_n = len(samples), sum(block.realisations for block in samples[0])
        row = {block: rows[ledger_key(point.digest, block)] for block in blocks}
        if isinstance(reducer, Sums):
            alone = [reducer.flat(ledger[[row[block] for block in one]]).sum(axis=0) for one in samples]
            without = reducer.typed(reducer.flat(total) - np.array(alone))
        else:
            without = _without_each(reducer, [ledger[place : place + 1] for place in row.values()])
            without = without[[blocks.index(first) for first, *_ in samples]]
        results = reducer.finish(without, np.full(count, n - alone_n), np.full(count, float(max(n_cat - 1, 1))))
        draws = np.array([n, float(n_cat)]).reshape(2, 1)
        twice = reducer.finish(reducer.add(total, total), *draws * [[2.0], [min(n_cat, 2.0)]])
        once = reducer.finish(total, *draws)
        scale = (n - alone_n) / np.sqrt(n * alone_n * (count - 1.0))  # sqrt((count - 1)/count), if these are all blocks
        for name, mine in deviations.items():
            values = np.reshape(results[name], (count, -1)).T
            with np.errstate(invalid="ignore", divide="ignore"):
                power = np.log2(np.reshape(twice[name] / once[name], (-1, 1)))  # 0 of a mean, 1 of a sum
            known = np.abs(power - np.round(power)) < 1e-9
            values = values * (n / (n - alone_n)) ** np.where(known, np.round(power), 0.0)
            mine[point.index] = 0.0
            mine[point.index, :, :count] = scale * (values - values.mean(axis=1, keepdims=True))
    return {name: grid.with_repeats(mine) for name, mine in deviations.items()}


def _without_each(reducer: Reducer, blocks: Sequence[Rows]) -> Rows:
    """Return what all blocks but each in turn leave of a point together, (blocks,), added up from both ends."""
    first, last = ([*accumulate(some, reducer.add)] for some in (blocks, blocks[::-1]))
    between = (reducer.add(before, after) for before, after in zip(first[:-2], last[-3::-1], strict=True))
    return np.concatenate([last[-2], *between, first[-2]])


def _covariance(plan: Plan, deviations: Mapping[str, Array], output: Output, dimension: str, samples: int) -> Variable:
    grid, dimensions = plan.grid, list(plan.grid.dimensions)
    shaped = deviations[output.name].reshape(*grid.shape, *grid.study.experiment.shape_of(output), -1)
    shaped = np.moveaxis(shaped, dimensions.index(dimension), -2)
    covariance = shaped @ np.swapaxes(shaped, -1, -2)
    meaning = f"covariance of {output.name} between points along {dimension}"
    attributes = described(squared(output.unit), meaning) | {"samples": samples}
    others = (d for d in dimensions if d != dimension)
    return Variable((*others, *output.dims, dimension, f"{dimension}_other"), covariance, attributes)


def squared(unit: str) -> str:
    """Return the square of a unit in the same notation: ``mas2 / yr2`` of ``mas / yr`` (no reader of units knows the
    power of a bracket with a solidus in it).
    """
    return re.sub(r"([A-Za-z]+)(?:\*\*|\^)?(-?\d+)?", lambda part: f"{part[1]}{2 * int(part[2] or 1)}", unit)
