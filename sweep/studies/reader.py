"""From a study file to a Study: finds it, reads it, and reports every problem at once."""

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sweep.contract import Experiment, SweepError, Value, shown, suggest
from sweep.formatting import first_of
from sweep.load import absolute_reference, read_experiment
from sweep.studies.axes import axis_values, override, override_points
from sweep.studies.claims import ClaimContext, checked_claim
from sweep.studies.conclusion import checked_conclusion
from sweep.studies.definitions import defined_values
from sweep.studies.exclusions import exclusion
from sweep.studies.form import Form, known_keys
from sweep.studies.points import read_points
from sweep.studies.problems import Problems
from sweep.studies.published import read_published
from sweep.studies.rules import check_sampling, zipped_axes
from sweep.studies.source import Place, find_study, parsed, read_text, reference_in
from sweep.studies.study import POINT, Claim, Conclusion, PointTable, Sampling, Study
from sweep.tables.file import TableFile, table_file

ONCE = Sampling(n_sim=1)
"""The sampling of what is computed once."""


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
    problems: list[str] = []
    overridden: dict[Place, str] = {}
    before = set(document.get("axes", {})) if isinstance(document.get("axes"), dict) else set()
    for setting in settings:
        overridden[override(document, setting, problems, as_axis=False)] = f"--set {_option(setting)}"
    for axis in axes:
        overridden[override(document, axis, problems, as_axis=True)] = f"--axis {_option(axis)}"
    if any(place[:1] == ("fixed",) or (place[:1] == ("axes",) and place[1] not in before) for place in overridden):
        document.pop("conclusion", None)  # its words are about the parameters that the study fixes
    chosen = [("--points", points), ("--design", design), *(("--range", text) for text in ranges)]
    if laid := [f"{flag} {_option(text)}" for flag, text in chosen if text is not None]:
        document.pop("conclusion", None)
        override_points(document, points, design, ranges, problems)
        overridden[("points",)] = laid[0]
    overrides = tuple([f"--set {s}" for s in settings] + [f"--axis {a}" for a in axes] + laid)
    return _Reader(document, text, path, problems, overrides, overridden, where=function).study()


def study_from_dict(document: Mapping[str, Any], name: str = "study", where: str | None = None) -> Study:
    """Return the study that a mapping of the same shape as the TOML file describes; raises SweepError, which says
    ``where``, as `load_study`.
    """
    return _Reader(dict(document), "", Path.cwd() / f"{name}.toml", [], (), {}, where=where).study()


def study_of_attributes(
    attributes: Mapping[str, Any], where: str, experiment: Callable[[str], Experiment] | None = None
) -> Study:
    """Return the study whose results have these attributes; raises SweepError as `load_study`, for example where the
    file of its experiment is gone.

    Published numbers are left out if their file is.  ``experiment`` returns what stands for the one of a reference,
    which is imported otherwise.
    """
    try:
        document = json.loads(attributes["study_document"])
        text, overrides, name = (str(attributes[key]) for key in ("study", "study_overrides", "study_name"))
    except (KeyError, TypeError, ValueError) as error:
        raise SweepError("does not say which study it holds", where) from error
    if "published" in document and not Path(document["published"]["file"]).is_file():
        del document["published"]
    changed: dict[Place, str] = {
        (table, key): "" for table in ("axes", "fixed") for key in document.get(table, {}) if overrides
    }
    laid_over = (overrides,) if overrides else ()
    return replace(_Reader(document, text, Path(where), [], laid_over, changed, experiment).study(), name=name)


def _option(text: str) -> str:
    return text if text.isprintable() and len(text) <= 80 else shown(text)


class _Reader:
    """Reads one document into a Study, gathering every problem on the way."""

    def __init__(
        self,
        document: dict[str, Any],
        text: str,
        path: Path,
        problems: list[str],
        overrides: tuple[str, ...],
        overridden: Mapping[Place, str],
        experiment: Callable[[str], Experiment] | None = None,
        where: str | None = None,
    ) -> None:
        self.find_experiment = experiment
        self.document, self.text, self.path = document, text, path
        self.where = where or str(path)
        self.problems = Problems(text, Path(self.where), problems, overridden)
        self.overrides, self.overridden = overrides, overridden

    def study(self) -> Study:
        form = self._form()
        experiment = None if form is None else self._experiment(form)
        if form is None or experiment is None:
            raise SweepError(self.problems.found, self.where)
        if experiment.deterministic:
            form = self._without_sampling_of_parameters(form, experiment)
        experiment, definitions = defined_values(experiment, form.define, self.path.parent, self.problems.add)
        points, origin, columns = self._points(experiment, form)
        axes = points | {name: self._axis(experiment, name, spec) for name, spec in form.axes.items()}
        fixed = {name: self._fixed(experiment, form, name, raw) for name, raw in form.fixed.items()}
        self._check_required(experiment, form, points)
        crossed = {name: values for name, values in axes.items() if name in form.axes}
        zipped = zipped_axes(form.grid.zip, crossed, self.problems)
        value = partial(self._value, experiment)
        given = {*axes, *form.fixed}
        excluded = tuple(
            exclusion(experiment, given, i, clause, self.problems, value) for i, clause in enumerate(form.exclude)
        )
        published = None
        if form.published is not None:
            published = read_published(form.published, self.path.parent, experiment, axes, self.problems)
        check_sampling(form.sampling, experiment, self.problems)
        around = self._claim_context(experiment, form, crossed)
        claims = self._claims(form, around)
        conclusion = self._conclusion(form, around)
        self.problems.raise_if_any()
        return Study(
            name=self.path.stem,
            title=form.title,
            question=form.question or "",
            experiment_reference=absolute_reference(form.experiment, self.path.parent),
            experiment=experiment,
            axes={name: values for name, values in axes.items() if values is not None},
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
            overrides=self.overrides,
            document=self._portable(form, fixed, columns, origin) | ({"define": definitions} if definitions else {}),
        )

    def _portable(
        self, form: Form, fixed: Mapping[str, Value], columns: Mapping[str, list[Any]], origin: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the document with places of files that hold from any directory, and the values of a table of points,
        wherever they come from.
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
            if key in names and self.overridden.get(("sampling", key))
        }
        if not moved:
            return form
        rest = {key: value for key, value in self.document["sampling"].items() if key not in moved}
        fixed = {**self.document.get("fixed", {}), **moved}
        axes = {key: value for key, value in self.document.get("axes", {}).items() if key not in moved}
        self.document = {**self.document, "sampling": rest, "fixed": fixed, "axes": axes}
        if not rest:
            del self.document["sampling"]
        return Form.model_validate(self.document)

    def _points(
        self, experiment: Experiment, form: Form
    ) -> tuple[dict[str, tuple[Value, ...] | None], dict[str, Any], Mapping[str, list[Any]]]:
        """Return the values of a table of points by parameter, where it comes from, and its columns as written."""
        if form.points is None:
            return {}, {}, {}
        parameters, outputs = ({one.name for one in ones} for ones in (experiment.parameters, experiment.outputs))
        if POINT in parameters | outputs | experiment.coordinates.keys():
            self.problems.add(("points",), f"{experiment.name} has a {POINT!r} of its own, the name of this dimension")
        columns, origin = read_points(form.points, experiment, form.fixed, self.path.parent, self.problems)
        found: dict[str, tuple[Value, ...] | None] = {}
        for name, raw_values in columns.items():
            where = ("points", "columns" if form.points.columns else "file" if form.points.file else "ranges", name)
            if name in {**form.axes, **form.fixed}:
                what = "an axis" if name in form.axes else "fixed"
                self.problems.add(where, f"is {what} too; leave out one of the two")
            try:
                if not (parameter := experiment.parameter(name)).may_be_axis:
                    raise ValueError(f"a {parameter.kind} cannot differ from point to point")
            except ValueError as error:
                self.problems.add(where, str(error))
                continue
            found[name] = self._values(experiment, where, name, raw_values, row=True)
        return found, origin, columns

    def _check_required(self, experiment: Experiment, form: Form, points: Mapping[str, object]) -> None:
        for parameter in experiment.parameters:
            if parameter.required and parameter.name not in {**form.axes, **form.fixed, **points}:
                sentence = f"{parameter.name} has no default: the study must set it, here or in [axes]"
                self.problems.add(("fixed", parameter.name), sentence)

    def _form(self) -> Form | None:
        try:
            return Form.model_validate(self.document)
        except ValidationError as error:
            for item in error.errors():
                where = tuple(item["loc"])
                if item["type"] == "extra_forbidden":
                    self.problems.add(where, f"unknown key{suggest(str(where[-1]), known_keys(where))}")
                elif item["type"] == "missing":
                    self.problems.add(where, "is required")
                elif item["type"] == "value_error":
                    self.problems.add(where, f"{shown(item['input'])} {item['ctx']['error']}")
                else:
                    self.problems.add(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown(item['input'])}")
            return self._rest_of_form({item["loc"][0] for item in error.errors()})

    def _rest_of_form(self, broken: set[str | int]) -> Form | None:
        """Return the form without its broken sections, so that the others are checked too."""
        if "experiment" in broken:
            return None
        if {"axes", "points"} & broken:
            broken = broken | {"grid", "claim", "conclusion", "published"}
        if "grid" in broken:
            broken = broken | {"claim", "conclusion"}
        rest = {key: value for key, value in self.document.items() if key not in broken}
        return Form.model_validate({"title": "", **rest})

    def _experiment(self, form: Form) -> Experiment | None:
        if self.find_experiment is not None:
            return self.find_experiment(form.experiment)
        try:
            return read_experiment(form.experiment, self.path.parent)
        except SweepError as error:
            for problem in error.problems:
                self.problems.add(("experiment",), f"{error.where}: {problem}" if error.where else problem)
            return None

    def _fixed(self, experiment: Experiment, form: Form, name: str, raw: object) -> Value:
        if name in form.axes:
            self.problems.add(("fixed", name), "is an axis too; leave out one of the two")
        return self._value(experiment, ("fixed", name), name, raw)

    def _value(self, experiment: Experiment, where: Place, name: str, raw: object, which: str = "") -> Value:
        try:
            parameter = experiment.parameter(name)
            value = parameter.parse(raw)
            folder = Path.cwd() if where[:2] in self.overridden else self.path.parent
            return table_file(folder / value) if parameter.kind == "file" else value
        except ValueError as error:
            self.problems.add(where, f"{which}{error}")
        except SweepError as error:
            self.problems.add(where, f"{shown(raw)}: {error}")
        return None

    def _axis(self, experiment: Experiment, name: str, spec: object) -> tuple[Value, ...] | None:
        where = ("axes", name)
        try:
            parameter = experiment.parameter(name)
            if not parameter.may_be_axis:
                raise ValueError(f"a {parameter.kind} cannot be an axis")
            raw_values = axis_values(spec, whole=parameter.kind == "int")
        except ValueError as error:
            self.problems.add(where, str(error))
            return None
        if not raw_values:
            self.problems.add(where, "an axis needs at least one value")
        if (values := self._values(experiment, where, name, raw_values)) is None:
            return None
        repeated = [shown(value) for value, n in Counter(values).items() if n > 1]
        if repeated:
            self.problems.add(where, f"duplicate value{'s' if len(repeated) > 1 else ''} {first_of(repeated, 10)}")
        return values

    def _values(
        self, experiment: Experiment, where: Place, name: str, raw_values: Sequence[object], row: bool = False
    ) -> tuple[Value, ...] | None:
        """Return the values along an axis, None if any is wrong; problems name the ``row`` of a table, from 1."""
        before = len(self.problems.found)
        values = []
        for number, raw in enumerate(raw_values, start=1):
            values.append(self._value(experiment, where, name, raw, f"row {number}: " if row else ""))
            if len(self.problems.found) >= before + 5:
                self.problems.add(where, "... and perhaps more values like these")
                return None
        if len(self.problems.found) > before:
            return None
        if experiment.parameter(name).kind == "any":
            kinds = {type(value) for value in values}
            if kinds == {int, float}:
                values = [float(value) for value in values]
            elif len(kinds) > 1:
                named = ", ".join(sorted(kind.__name__ for kind in kinds))
                self.problems.add(where, f"has values of several types ({named}); an axis is of one")
                return None
        return tuple(values)

    def _claim_context(
        self, experiment: Experiment, form: Form, axes: Mapping[str, tuple[Value, ...] | None]
    ) -> ClaimContext:
        changed = frozenset(str(place[1]) for place in self.overridden if place[:1] in (("axes",), ("fixed",)))
        return ClaimContext(experiment, axes, form.grid.zip, changed)

    def _conclusion(self, form: Form, around: ClaimContext) -> Conclusion | None:
        if form.conclusion is None:
            return None
        return checked_conclusion(form.conclusion, around, self.problems.add)

    def _claims(self, form: Form, around: ClaimContext) -> tuple[Claim, ...]:
        return tuple(
            checked_claim(claim, around, partial(self._claim_problem, i)) for i, claim in enumerate(form.claim)
        )

    def _claim_problem(self, index: int, place: tuple[str, ...], message: str) -> None:
        self.problems.add(("claim", index, *place), message)
