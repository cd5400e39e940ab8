"""The platform as functions, for scripts and notebooks."""

import base64
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, chdir, nullcontext
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from rich.console import Console

from linksweep.sweep.analysis.answer import answer_in_short, completeness
from linksweep.sweep.contract import Experiment, SweepError, shown
from linksweep.sweep.executing.pools import NO_LIMITS, Limits, PoolName, Resources
from linksweep.sweep.formatting import harmless, with_micro_signs
from linksweep.sweep.result import Result, open_result
from linksweep.sweep.running import progress as watching
from linksweep.sweep.running.reproduce import verify as verified
from linksweep.sweep.running.run import ALL, Beside, run_study, with_part
from linksweep.sweep.stores.location import Location, Where, default_store, store_named
from linksweep.sweep.studies.points import plain_value
from linksweep.sweep.studies.reader import live_study, load_study, reference_in, study_of_function
from linksweep.sweep.studies.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run(
    study: str | Path | Mapping[str, Any] | Study | Callable[..., Any],
    store: Where | None = None,
    *,
    axes: Mapping[str, Any] | None = None,
    fixed: Mapping[str, Any] | None = None,
    points: Any = None,
    labels: str | Sequence[str] | None = None,
    exclude: Sequence[Mapping[str, Any]] | None = None,
    when: Mapping[str, Mapping[str, Any]] | None = None,
    sampling: Mapping[str, Any] | None = None,
    title: str | None = None,
    workers: int | None = None,
    pool: PoolName | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    client: Any = None,
    limits: Limits = NO_LIMITS,
    dashboard: bool = False,
    progress: watching.Progress | bool | None = None,
    accept_code: bool = False,
    retry: bool = False,
    fresh: bool = False,
    only: bool = False,
    keep: bool = False,
    redo: str = "",
    max_failures: int | str | None = None,
    verify: int = 0,
    part: str | None = None,
) -> xr.Dataset:
    """Run a study, or sweep a function, and return the results.

    After an interruption the same call resumes where it stopped.  Points that failed are NaN in the dataset; the
    variable ``status`` and the attribute ``failures`` say why, and a warning is logged.

    Args:
        study: a function; or the name of a built-in study, the path of a TOML file, a mapping with the same content
            (whose experiment may be a function), or a `Study`.
        store: a path or s3://BUCKET/NAME; ``results/NAME.zarr`` by default, where the NAME for a function or mapping
            ends with a digest of everything that is asked for.
        axes: the values of each parameter of the function that is swept: lists, arrays, ranges or pandas indexes, or a
            range as in a study.
        fixed: values of other parameters of the function.
        points: values of several parameters of the function at once: a DataFrame, an astropy Table or a mapping with a
            column for each parameter, the name of a file with such a table, or a design, ``{"design": "sobol",
            "n": 256, "seed": 0, "ranges": {"beta": [0.1, 0.5]}}``.  They are crossed with ``axes``.
        labels: columns of the table of points that are no parameters but say what a point is: they become coordinates
            along ``point``, as does the index of a DataFrame unless it counts the rows from 0.
        exclude: points that are left out: mappings as in a study, ``[{"kernel": "linear", "gamma": {"above": 1.0}}]``.
        when: parameters that have an effect only with some values of others, ``{"gamma": {"kernel": ["rbf"]}}``: where
            they have none, there is one point, in which they are missing.
        sampling: n_sim, seed, precision and max_n_sim of a function that takes ``rng``.
        title: the title of a function in tables and figures.
        workers: the number of processes or threads; one per core by default.
        pool: the kind of executor on this machine: "processes" (the default), "threads", or "serial" for small work.
        scheduler: the address of a Dask scheduler to run on instead.
        cluster: a file that describes a Dask cluster to start and run on instead.
        client: a connected, synchronous `distributed.Client` to run on instead; it stays open.
        limits: the time and memory that one block may take.
        dashboard: give local workers Dask's dashboard, whose address is logged; it needs bokeh.
        accept_code: continue a store that other code made, and record for each point which code made it; otherwise
            such a store is refused.
        retry: compute the points that failed again, and no others.
        fresh: replace the store.
        only: leave points that are not asked for out of the dataset in the store, which else has those of earlier runs
            too; they stay in its ledger.
        keep: let parameters outside the axes that have other values in the store become axes there, instead of refusing
            it.
        redo: a condition on parameters, "x > 2 and y == 8": finished points of the store that meet it are computed
            again; ``old`` is true for points that other code made.
        max_failures: end the run when more points than this number, or than this percentage, "5%", of those that were
            tried fail; by default if the first 20 all fail for the same reason, with "100%" never.
        progress: an object that is notified of the progress; by default a bar in terminals and notebooks, with False
            none.
        part: "K/N" computes part K of N alone, into the store STORE.part-K-of-N, and "array" the part of this task of a
            SLURM job array; `sweep merge` makes one of all parts.
        verify: compute so many points again at the end, each by itself in new processes, in two orders, and compare
            every bit; the results are in the store all the same.

    Returns:
        The outputs of the study over its axes, in memory, but for large arrays, which are read from the store as they
        are used; `open` returns all points of the store.

    Raises:
        SweepError: for bad input, before anything is written; where too many points fail, or ``verify`` finds some that
            differ, with what was done kept.
        KeyboardInterrupt: on Ctrl-C and signals that end a process; what was done is kept.

    Example:
        >>> study = {
        ...     "title": "Quasars to V = 15",
        ...     "axes": {"model": ["amex", "gaia"]},
        ...     "fixed": {"catalogue": "quasars", "v_max": 15.0},
        ...     "sampling": {"n_sim": 100, "seed": 7},
        ... }
        >>> ds = run(study, "quasars15.zarr", pool="serial")
        >>> ds.sigma_spin.sizes["model"], ds.sigma_spin.units
        (2, 'mas / yr')
        >>> def area(width: float, height: float = 1.0):
        ...     return width * height
        >>> run(area, axes={"width": [1.0, 2.0]}, fixed={"height": 3.0}, pool="serial").area.values.tolist()
        [3.0, 6.0]
    """
    if type(verify) is not int or verify < 0:
        raise SweepError(f"verify = {shown(verify)}: must be a number of points, from 0")
    beside = Beside(retry, fresh, only, keep, redo)
    options = {"axes": axes, "fixed": fixed, "sampling": sampling, "title": title}
    more = {"points": points, "labels": labels, "exclude": exclude, "when": when}
    loaded, place = _study(study, options | more, store, part)
    resources = Resources(plain_value(workers), pool, scheduler, None, cluster, limits, dashboard, client)
    with _watching(loaded, progress) as watcher:
        dataset, failures = run_study(loaded, place, resources, watcher, accept_code, max_failures, beside)
    if failures:
        watching.SENTENCES.warning("%s: %s", place, harmless(watching.failed_points(failures)))
    if verify and (differing := verified(loaded, place, verify)[1]):
        raise SweepError(differing, str(place))
    return _drawable(dataset.to_xarray())


def refine(
    study: str | Path | Mapping[str, Any] | Study | Callable[..., Any],
    store: Where | None = None,
    *,
    find: str | None = None,
    until: str | None = None,
    within: float | None = None,
    along: str | None = None,
    variable: str | None = None,
    max_realisations: int | None = None,
    **options: Any,
) -> xr.Dataset:
    """Run a study, then add the points and realisations that matter next, round by round, into the same store.

    After an interruption the same call goes on where it stopped.  See the page on refining.

    Args:
        study: as for `run`.
        store: as for `run`.
        find: a condition, "sigma_spin < 0.6 mas/yr": points locate where it begins or ceases to be met.
        until: instead of ``find``, a limit of the error of values between points, "error < 0.002": points are added
            where a value differs by more from what its neighbours on the axis give.
        within: how well to locate it, in the unit of the axis; for ``until`` the shortest interval, by default a
            thousandth of the axis, as if all its steps were as short as the shortest.
        along: the axis that gets points; by default the only one with several numbers.
        variable: for ``until``, the output; by default the main one.
        max_realisations: how many there may be in all, besides those that the study itself has; by default points get
            no more from a fifth of those of the full grid on, and new points are not limited.
        options: further arguments of `run`: ``axes``, ``sampling``, ``workers`` and so on; but not ``part``, ``fresh``,
            ``retry``, ``only``, ``keep`` and ``redo``, which are about a single run.

    Returns:
        The outputs of the study with its further points, over its axes; the attribute ``refined`` has all rounds, as
        JSON.

    Raises:
        SweepError: as `run`, and for a goal that does not suit the study.

    Example:
        >>> import linksweep
        >>> def decay(t: float):
        ...     return 0.5**t
        >>> ds = linksweep.refine(decay, axes={"t": [0.0, 4.0, 8.0]}, find="decay < 0.1", within=0.01, pool="serial")
        >>> ds.sizes["t"], round(float(linksweep.find(ds, "decay < 0.1", over="t")["first"]), 3)
        (12, 3.322)
    """
    from linksweep.sweep.analysis.refine import refinements

    if wrong := [name for name in (*vars(ALL), "part") if options.get(name)]:
        raise SweepError(f"{wrong[0]} is an argument of run, and not of refine")
    names = ("axes", "fixed", "points", "labels", "exclude", "when", "sampling", "title")
    loaded, place = _study(study, {name: options.pop(name) for name in names if name in options}, store)
    goal = {"find": find, "until": until, "within": within, "along": along, "variable": variable}
    *_, last = refinements(loaded, place, goal | {"most": max_realisations}, lambda now: run(now, place, **options))
    return last.dataset


def open(  # noqa: A001 (linksweep.open, as xarray and zarr have theirs)
    store: Where, *, running: bool = False
) -> xr.Dataset:
    """Return the results in a store, in memory but for large arrays of floats, which are read as they are used.  During
    a run all of them are from the same write of the dataset.

    Results of `sweep tie -o` and `sweep forecast -o` can be read too.

    Args:
        store: a path, s3://BUCKET/NAME, or the name of a study that was run in this directory.
        running: give points that are begun and not done their values so far, with their present errors; the
            ``status`` of these points is then 4 ("running"), and ``n_sim_done`` counts the realisations in them.  By
            default they are NaN.

    Returns:
        The outputs of the study over its axes, with units and errors.

    Raises:
        SweepError: if there is no store, if it has no results yet, or if it is damaged.

    Example:
        >>> study = {"title": "One point", "fixed": {"n_obj": 20}, "sampling": {"n_sim": 10}}
        >>> saved = run(study, "one.zarr", pool="serial")
        >>> open("one.zarr").equals(saved)
        True
    """
    place = store_named(store)
    return _drawable(open_result(place, running).dataset)


def _drawable(dataset: xr.Dataset) -> xr.Dataset:
    """Return results whose text coordinates have a fixed width: xarray cannot plot over others."""
    texts = {name: values for name, values in dataset.coords.items() if values.dtype.kind == "T"}
    fixed = {n: (v.dims, np.array(v.values.tolist(), dtype=np.str_), v.attrs) for n, v in texts.items()}
    return dataset.assign_coords(fixed)


@dataclass(frozen=True)
class Card:
    """What results say: ``print`` shows the sentences, a notebook the figure too.

    ``sentences`` are those of the answer, after what is missing if the results are incomplete; a link or a forecast of
    real tables has the ``table`` of its unknowns instead.
    """

    title: str
    question: str
    sentences: list[str]
    dataset: xr.Dataset
    table: str = ""

    def __repr__(self) -> str:
        return harmless("\n".join(filter(None, [self.question or self.title, *self.sentences, self.table])))

    def _repr_html_(self) -> str:
        """Return the card; colours are those of the notebook, in either theme."""
        heading = f"<p><strong>{escape(self.question or self.title)}</strong></p>"
        sentences = "".join(f"<p>{escape(with_micro_signs(sentence))}</p>" for sentence in self.sentences)
        table = f"<pre>{escape(self.table)}</pre>" if self.table else ""
        return f'<div style="max-width: 46rem">{heading}{sentences}{table}{_picture(self.dataset)}</div>'


def _picture(dataset: xr.Dataset) -> str:
    """Return the figure as an image that is part of the page; a sentence where there is none."""
    out = io.BytesIO()
    try:
        from linksweep.sweep.plots.figure import draw_figure
        from linksweep.sweep.plots.style import description, settings

        with settings():
            figure = draw_figure(dataset.assign_attrs(title=""))
            figure.savefig(out, format="png", dpi=150)
    except ImportError:
        return "<p><small>A figure needs Matplotlib: <code>pip install 'linksweep[plot]'</code></small></p>"
    except (SweepError, ValueError) as error:  # a ValueError: a name that matplotlib takes for a formula
        return f"<p><small>{escape(f'No figure: {error}')}</small></p>"
    image, words = base64.b64encode(out.getvalue()).decode(), escape(description(figure, dataset), quote=True)
    return f'<img src="data:image/png;base64,{image}" alt="{words}" style="max-width: 100%; background: #ffffff">'


def answer(dataset: xr.Dataset) -> Card:
    """Return the answer that results give: ``print`` shows question and answer, a notebook also the figure.

    Args:
        dataset: what `run`, `open`, `tie` or `forecast` returned, or a part of it.

    Returns:
        A card with ``title``, ``question`` and ``sentences``; for a link or a forecast also with the ``table`` of its
        unknowns.  Its figure, in a notebook, needs Matplotlib.

    Raises:
        SweepError: for a dataset that is none of these.

    Example:
        >>> study = {
        ...     "title": "Two limits",
        ...     "question": "What do fainter quasars bring?",
        ...     "axes": {"v_max": [14.0, 16.0]},
        ...     "fixed": {"catalogue": "quasars", "model": "gaia"},
        ...     "sampling": {"n_sim": 50, "seed": 1},
        ... }
        >>> answer(run(study, "limits.zarr", pool="serial")).question
        'What do fainter quasars bring?'
    """
    result = Result(dataset)
    if result.kind != "grid":
        return Card(result.title, "", result.headline(), dataset, result.written("text"))
    question, sentences = str(dataset.attrs.get("question", "")), [*completeness(dataset), *answer_in_short(dataset)]
    return Card(result.title, question, sentences, dataset)


def plot(
    dataset: xr.Dataset,
    kind: str | None = None,
    variables: Sequence[str] = (),
    over: Sequence[str] = (),
    log: Sequence[str] = (),
    linear: Sequence[str] = (),
) -> "Figure":
    """Return a figure of the results of a study, a link or a forecast.

    Needs Matplotlib: ``pip install 'linksweep[plot]'``.

    Args:
        dataset: what `run`, `open`, `tie`, `forecast` or `sensitivity` returned, or a part of it.
        kind: "lines", "law", "map", "scatter", "points", "pairs" or "curves"; for a link "solution", "residuals",
            "separations", "weight", "ranking", "jackknife", "trajectory", "spectrum" or "bins"; for a forecast "epochs"
            or "ranking".  By default the kind that suits the dataset.
        variables: names of outputs, one column of panels each; the main result by default.  Here and below one name
            may be a string.
        over: the axis along which curves are drawn, the two axes of a map, or the two components of a scatter plot.
        log: axes and quantities with a logarithmic axis.
        linear: those with a linear one.  All others have what the study says, or what the spacing of their values
            suggests: linear for equal steps, logarithmic for equal ratios.

    Returns:
        A Matplotlib figure without a window; ``figure.savefig("name.svg")`` writes it, a notebook shows it.

    Raises:
        SweepError: for a kind that does not suit the dataset (the message lists those that do) or an unknown variable.

    Example:
        >>> study = {
        ...     "title": "More objects",
        ...     "axes": {"n_obj": [20, 80, 320]},
        ...     "sampling": {"n_sim": 50, "seed": 1},
        ... }
        >>> figure = plot(run(study, "more.zarr", pool="serial"), kind="lines")
        >>> figure.savefig("more.svg")
    """
    from linksweep.sweep.plots.figure import draw_figure

    names = ([one] if isinstance(one, str) else one for one in (variables, over, log, linear))
    return draw_figure(dataset, kind, *names)


def _study(
    study: str | Path | Mapping[str, Any] | Study | Callable[..., Any],
    options: dict[str, Any],
    store: Where | None,
    part: str | None = None,
) -> tuple[Study, Location]:
    """Return a study, or a part of it, and where its store is."""
    here = Path.cwd()  # before the study is loaded, whose code may change it
    loaded = _loaded(study, options)
    with chdir(here):
        return with_part(loaded, default_store(loaded.name) if store is None else store, part)


def _loaded(study: str | Path | Mapping[str, Any] | Study | Callable[..., Any], options: dict[str, Any]) -> Study:
    reference = reference_in(study) if isinstance(study, str) else None
    if reference is not None or callable(study) or isinstance(study, Experiment):
        return study_of_function(reference or study, **options)  # type: ignore[arg-type]
    if not isinstance(study, (str, Path, Mapping, Study)):
        raise SweepError(f"{shown(study)} is neither a function nor a study")
    if isinstance(study, Mapping):
        study = live_study(study)
    loaded = study if isinstance(study, Study) else load_study(study)
    if stray := [name for name, value in options.items() if value is not None]:
        how = 'load_study("NAME", axes=["x=1,2"], settings=["n_sim=50"]) changes them'
        raise SweepError(f"{', '.join(stray)}: allowed only for a function; a study has its own; {how}")
    return loaded


def _watching(study: Study, progress: watching.Progress | bool | None) -> AbstractContextManager[watching.Progress]:
    """Return the object that is notified of a run's progress: that which is passed, or a bar where somebody sees it."""
    if progress is not None and progress is not True:
        return nullcontext(progress or watching.SILENT)  # False shows none
    if Console().is_jupyter:
        return watching.NotebookProgress(study, bar=False)
    if sys.stderr is not None and sys.stderr.isatty():
        return watching.TerminalProgress(study)
    return nullcontext(watching.SILENT)
