"""From a study file to a Study: finds it, reads it, and reports every problem at once."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from linksweep.sweep.code.load import Code, absolute_reference
from linksweep.sweep.contract import Experiment, SweepError, Value
from linksweep.sweep.studies.claims import ClaimContext, check_figure, checked_claim, checked_conclusion
from linksweep.sweep.studies.definitions import defined_values
from linksweep.sweep.studies.form import Form, Sampling
from linksweep.sweep.studies.form_reader import read_form
from linksweep.sweep.studies.overrides import Overrides, override
from linksweep.sweep.studies.points import read_points
from linksweep.sweep.studies.problems import Problems
from linksweep.sweep.studies.rules import check_sampling, exclusion, read_published, zipped_axes
from linksweep.sweep.studies.source import find_study, parsed, read_text, reference_in
from linksweep.sweep.studies.study import POINT, PointTable, Study
from linksweep.sweep.studies.values import Values
from linksweep.sweep.tables.file import TableFile

ONCE = Sampling(n_sim=1)
"""The sampling of a deterministic experiment, which is evaluated once at each point."""


def load_study(
    name_or_path: str,
    settings: Sequence[str] = (),
    axes: Sequence[str] = (),
    points: str | None = None,
    design: str | None = None,
    ranges: Sequence[str] = (),
) -> Study:
    """Read and check a study, without running it.

    Args:
        name_or_path: the name of a built-in study, the path of a file, or ``file.py:function`` and
            ``module:function``, which are studies by themselves.
        settings: ``KEY=VALUE``, overrides like those of ``sweep run --set``.
        axes: ``NAME=SPEC``, overrides like those of ``sweep run --axis``.
        points: the file of a table of points that replaces the study's, as in ``sweep run --points``.
        design: ``NAME:N`` or ``NAME:N:SEED``, replaces the study's points, as in ``sweep run --design``.
        ranges: ``NAME=LOW:HIGH``, ``NAME=LOW:HIGH:log`` or ``NAME=A,B,C`` of a design, as in ``sweep run --range``.

    Returns:
        The study; all its parameters have values that the experiment allows.

    Raises:
        SweepError: with all problems, each with its key and, if it has one, its line in the file.

    Example:
        >>> study = load_study("quasars", settings=["n_sim=50"], axes=["v_max=14:16:0.5"])
        >>> study.axes["v_max"], study.sampling.n_sim
        ((14.0, 14.5, 15.0, 15.5, 16.0), 50)
    """
    if (function := reference_in(name_or_path)) is not None:
        path, text = Path.cwd() / f"{function.rpartition(':')[2]}.toml", ""
        document: dict[str, Any] = {"title": path.stem, "experiment": function}
    else:
        path = find_study(name_or_path)
        text = read_text(path)
        document = parsed(text, path)
    overrides = override(document, settings, axes, points, design, ranges)
    return _Reader(document, text, path, function or str(path), overrides, Code()).study()


def study_from_dict(
    document: Mapping[str, Any], name: str = "study", where: str | None = None, code: Code | None = None
) -> Study:
    """Return the study that a mapping of the same shape as the TOML file describes; raises SweepError, which says
    ``where``, as `load_study`.
    """
    path = Path.cwd() / f"{name}.toml"
    return _Reader(dict(document), "", path, where or str(path), Overrides(), code or Code()).study()


def study_of_attributes(attributes: Mapping[str, Any], where: str, code: Code) -> Study:
    """Return the study whose results have these attributes; raises SweepError as `load_study`, for example where the
    file of its experiment is gone.

    All that it names is loaded by ``code`` or not at all.  Published numbers are left out if their file is gone.
    """
    try:
        document = json.loads(attributes["study_document"])
        text, overrides, name = (str(attributes[key]) for key in ("study", "study_overrides", "study_name"))
    except (KeyError, TypeError, ValueError) as error:
        raise SweepError("does not say which study it holds", where) from error
    if "published" in document and not Path(document["published"]["file"]).is_file():
        del document["published"]
    laid = Overrides()
    if overrides:
        laid = Overrides((overrides,), {(table, k): "" for table in ("axes", "fixed") for k in document.get(table, {})})
    return replace(_Reader(document, text, Path(where), where, laid, code).study(), name=name)


@dataclass
class _Reader:
    """Reads one document into a Study, gathering every problem on the way."""

    document: dict[str, Any]
    text: str
    path: Path
    where: str
    overrides: Overrides
    code: Code

    def __post_init__(self) -> None:
        self.problems = Problems(self.where, self.text, self.overrides.problems, self.overrides.by_place)

    def study(self) -> Study:
        form = read_form(self.document, self.problems)
        experiment = None if form is None else self._experiment(form)
        if form is None or experiment is None:
            raise SweepError(self.problems.found, self.where)
        if experiment.deterministic:
            form = self._without_sampling_of_parameters(form, experiment)
        experiment, definitions = defined_values(experiment, form.define, self.path.parent, self.code, self.problems)
        values = Values(experiment, self.path.parent, self.problems)
        points, origin, columns = self._points(values, form)
        axes = points | {name: values.axis(name, spec) for name, spec in form.axes.items()}
        fixed = {}
        for name, raw in form.fixed.items():
            if name in form.axes:
                self.problems.add(("fixed", name), "is an axis too; leave out one of the two")
            fixed[name] = values.one(("fixed", name), name, raw)
        self._check_required(experiment, form, points)
        crossed = {name: axes[name] for name in form.axes}
        zipped = zipped_axes(form.grid.zip, crossed, self.problems)
        given = {*axes, *form.fixed}
        excluded = tuple(exclusion(i, clause, given, values) for i, clause in enumerate(form.exclude))
        published = None
        if form.published is not None:
            published = read_published(form.published, self.path.parent, experiment, axes, self.problems)
        check_sampling(form.sampling, experiment, self.problems.inside("sampling"))
        changed = frozenset(str(place[1]) for place in self.problems.overridden if place[:1] in (("axes",), ("fixed",)))
        context = ClaimContext(experiment, crossed, form.grid.zip, changed)
        claims = tuple(checked_claim(c, context, self.problems.inside("claim", i)) for i, c in enumerate(form.claim))
        conclusion = None
        if form.conclusion is not None:
            conclusion = checked_conclusion(form.conclusion, context, self.problems.inside("conclusion"))
        check_figure(form.figure, context, self.problems.inside("figure"))
        if self.problems.found:
            raise SweepError(self.problems.found, self.where)
        return Study(
            name=self.path.stem,
            title=form.title,
            question=form.question or "",
            experiment_reference=absolute_reference(form.experiment, self.path.parent),
            experiment=experiment,
            axes={name: found for name, found in axes.items() if found is not None},
            fixed=fixed,
            sampling=ONCE if experiment.deterministic else form.sampling,
            zipped=zipped,
            points=None if form.points is None else PointTable(tuple(points), origin),
            excluded=excluded,
            published=published,
            source=self.where,
            claims=claims,
            conclusion=conclusion,
            text=self.text,
            overrides=self.overrides.written,
            document=self._portable(form, fixed, columns, origin) | ({"define": definitions} if definitions else {}),
        )

    def _portable(
        self, form: Form, fixed: Mapping[str, Value], columns: Mapping[str, list[Any]], origin: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the document with absolute paths of files, and with the values of a table of points in place of its
        file or design.
        """
        document = {**self.document, "experiment": absolute_reference(form.experiment, self.path.parent)}
        if "fixed" in document:
            paths = {name: value.path for name, value in fixed.items() if isinstance(value, TableFile)}
            document["fixed"] = document["fixed"] | paths
        if form.points is not None:
            document["points"] = {"columns": dict(columns), **({"origin": dict(origin)} if origin else {})}
        if form.published is not None:
            file = str((self.path.parent / form.published.file).resolve())
            document["published"] = document["published"] | {"file": file}
        return document

    def _without_sampling_of_parameters(self, form: Form, experiment: Experiment) -> Form:
        """Return the form of a deterministic experiment in which ``--set seed=3`` has set its own parameter seed."""
        names = {parameter.name for parameter in experiment.parameters}
        moved = {
            key: value
            for key, value in form.sampling.model_dump(include=form.sampling.model_fields_set).items()
            if key in names and ("sampling", key) in self.problems.overridden
        }
        if not moved:
            return form
        rest = {key: value for key, value in self.document["sampling"].items() if key not in moved}
        axes = {key: value for key, value in form.axes.items() if key not in moved}
        changed = {"sampling": rest, "fixed": form.fixed | moved, "axes": axes}
        self.document = {**self.document, **changed}
        if not rest:
            del self.document["sampling"]
        return form.model_copy(update={**changed, "sampling": Sampling(**rest)})

    def _points(
        self, values: Values, form: Form
    ) -> tuple[dict[str, tuple[Value, ...] | None], dict[str, Any], Mapping[str, list[Any]]]:
        """Return the values of a table of points by parameter, where it comes from, and its columns as written."""
        if form.points is None:
            return {}, {}, {}
        experiment = values.experiment
        parameters, outputs = ({one.name for one in ones} for ones in (experiment.parameters, experiment.outputs))
        if POINT in parameters | outputs | experiment.coordinates.keys():
            self.problems.add(("points",), f"{experiment.name} has a {POINT!r} of its own, the name of this dimension")
        columns, origin = read_points(form.points, experiment, form.fixed, self.path.parent, self.code, self.problems)
        found: dict[str, tuple[Value, ...] | None] = {}
        for name, raw_values in columns.items():
            where = ("points", "columns" if form.points.columns else "file" if form.points.file else "ranges", name)
            if name in {**form.axes, **form.fixed}:
                what = "an axis" if name in form.axes else "fixed"
                self.problems.add(where, f"is {what} too; leave out one of the two")
            with self.problems.at(where):
                if not (parameter := experiment.parameter(name)).may_be_axis:
                    raise ValueError(f"a {parameter.kind} cannot differ from point to point")
                found[name] = values.several(where, name, raw_values, rows=True)
        return found, origin, columns

    def _check_required(self, experiment: Experiment, form: Form, points: Mapping[str, object]) -> None:
        if "points" in self.document and not points:
            return  # the table is wrong, and which parameters it has is not known
        for parameter in experiment.parameters:
            if parameter.required and parameter.name not in {**form.axes, **form.fixed, **points}:
                sentence = f"{parameter.name} has no default: the study must set it, here or in [axes]"
                self.problems.add(("fixed", parameter.name), sentence)

    def _experiment(self, form: Form) -> Experiment | None:
        try:
            return self.code.experiment(form.experiment, self.path.parent)
        except SweepError as error:
            for problem in error.problems:
                self.problems.add(("experiment",), f"{error.where}: {problem}" if error.where else problem)
            return None
