"""From a study file to a Study: finds it, reads it, and reports every problem at once."""

import csv
import json
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from sweep.axes import axis_values, is_number, override
from sweep.claims import Surroundings, checked_claim
from sweep.contract import Experiment, Parameter, SweepError, Value, shown, suggest
from sweep.load import absolute_reference, load_experiment
from sweep.study import Claim, Condition, Published, Ratio, Reading, Sampling, Section, Slope, Study, Tolerance
from sweep.tablefile import TableFile, table_file

MAX_FILE_BYTES = 1_000_000
MAX_PROBLEMS = 50
"""After so many problems of one study the rest is not looked for."""

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value of the document."""


class _Grid(Section):
    zip: list[list[str]] = Field(default_factory=list)


class _Published(Section):
    file: str
    source: str
    tolerance: Tolerance | None = None
    tolerance_reason: str | None = None


class _Form(Section):
    """The fixed part of a study file; axes and parameters are checked against the experiment."""

    title: str
    experiment: str = "core.experiment:link"
    axes: dict[str, Any] = Field(default_factory=dict)
    fixed: dict[str, Any] = Field(default_factory=dict)
    sampling: Sampling = Sampling()
    grid: _Grid = _Grid()
    exclude: list[dict[str, Any]] = Field(default_factory=list)
    published: _Published | None = None
    claim: list[Claim] = Field(default_factory=list)


def _known_keys(where: Place) -> list[str]:
    """Return the keys that are allowed beside the one at ``where``."""
    sections: dict[str | int, type[Section]] = {
        **{"sampling": Sampling, "grid": _Grid, "published": _Published, "claim": Claim},
        **{"slope": Slope, "ratio": Ratio, "value": Reading},
    }
    table = next((sections[key] for key in reversed(where[:-1]) if key in sections), _Form)
    return list(table.model_fields)


def built_in_studies() -> dict[str, Path]:
    """Return the studies that ship with the package, by name."""
    folder = resources.files("sweeps")
    return {
        p.name.removesuffix(".toml"): Path(str(p))
        for p in sorted(folder.iterdir(), key=str)
        if p.name.endswith(".toml")
    }


def load_study(name_or_path: str, settings: Sequence[str] = (), axes: Sequence[str] = ()) -> Study:
    """Return the study of a built-in name or a TOML file, with ``KEY=VALUE`` settings and ``NAME=SPEC`` axes laid over
    it.

    Raises SweepError that lists all problems, each with its key and, where it has one, its line in the file.
    """
    path = _find(name_or_path)
    text = _read(path)
    try:
        document = tomllib.loads(text)
    except ValueError as error:  # a TOMLDecodeError, or an integer of too many digits
        raise SweepError(f"not valid TOML: {error}{_quoted_line(text, str(error))}", str(path)) from error
    except RecursionError as error:
        raise SweepError("not valid TOML: nested too deeply", str(path)) from error
    problems: list[str] = []
    overridden: dict[Place, str] = {}
    for setting in settings:
        overridden[override(document, setting, problems, as_axis=False)] = f"--set {_option(setting)}"
    for axis in axes:
        overridden[override(document, axis, problems, as_axis=True)] = f"--axis {_option(axis)}"
    overrides = tuple([f"--set {s}" for s in settings] + [f"--axis {a}" for a in axes])
    return _Reader(document, text, path, problems, overrides, overridden).study()


def study_from_dict(document: Mapping[str, Any], name: str = "study") -> Study:
    """Return the study that a mapping of the same shape as the TOML file describes; raises SweepError as
    `load_study`.
    """
    return _Reader(dict(document), "", Path.cwd() / f"{name}.toml", [], (), {}).study()


def study_of_attributes(attributes: Mapping[str, Any], where: str) -> Study:
    """Return the study whose results have these attributes; raises SweepError as `load_study`, for example where the
    file of its experiment is gone.

    Published numbers are left out if their file is.
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
    return replace(_Reader(document, text, Path(where), [], laid_over, changed).study(), name=name)


def _option(text: str) -> str:
    return text if text.isprintable() and len(text) <= 80 else shown(text)


def _find(name_or_path: str) -> Path:
    built_in = built_in_studies()
    if name_or_path in built_in:
        return built_in[name_or_path]
    path = Path(name_or_path)
    try:
        if path.is_dir():
            raise SweepError(f"{name_or_path!r} is a directory, not a study file")
        exists = path.exists()
    except (OSError, ValueError) as error:  # for example a name that is too long, or a directory closed to us
        reason = getattr(error, "strerror", None) or str(error)
        raise SweepError(f"the study {shown(name_or_path)} cannot be read: {reason}") from error
    if not exists:
        hint = "" if path.suffix else suggest(name_or_path, list(built_in))
        raise SweepError(f"no study {name_or_path!r}: neither a file nor a built-in study{hint}")
    return path


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:  # no stat: a device or a pipe has no size
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise SweepError(f"cannot be read: {getattr(error, 'strerror', None) or error}", str(path)) from error
    if len(content) > MAX_FILE_BYTES:
        raise SweepError(f"is larger than {MAX_FILE_BYTES:,} bytes", str(path))
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise SweepError(f"not UTF-8 text: byte 0x{content[error.start]:02x} in line {line}", str(path)) from error


def _quoted_line(text: str, message: str) -> str:
    """Return the line that a message of the TOML parser speaks of, after a colon; nothing if it names none."""
    number = re.search(r"at line (\d+)", message)
    return f": {shown(text.splitlines()[int(number[1]) - 1].strip())}" if number else ""


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
    ) -> None:
        self.document, self.text, self.path, self.problems = document, text, path, problems
        self.overrides, self.overridden = overrides, overridden

    def study(self) -> Study:
        form = self._form()
        experiment = None if form is None else self._experiment(form)
        if form is None or experiment is None:
            raise SweepError(self.problems, str(self.path))
        axes = {name: self._axis(experiment, name, spec) for name, spec in form.axes.items()}
        fixed = {name: self._fixed(experiment, form, name, raw) for name, raw in form.fixed.items()}
        zipped = self._zip(form, axes)
        excluded = tuple(self._exclusion(experiment, form, i, clause) for i, clause in enumerate(form.exclude))
        published = self._published(experiment, form, axes)
        self._sampling(experiment, form.sampling)
        claims = self._claims(experiment, form, axes)
        if self.problems:
            raise SweepError(self.problems, str(self.path))
        return Study(
            name=self.path.stem,
            title=form.title,
            experiment_reference=absolute_reference(form.experiment, self.path.parent),
            experiment=experiment,
            axes={name: values for name, values in axes.items() if values is not None},
            fixed=fixed,
            sampling=form.sampling,
            zipped=zipped,
            excluded=excluded,
            published=published,
            source=str(self.path),
            claims=claims,
            text=self.text,
            overrides=self.overrides,
            document=self._portable(form, fixed),
        )

    def _portable(self, form: _Form, fixed: Mapping[str, Value]) -> dict[str, Any]:
        """Return the document with places of files that hold from any directory."""
        document = {**self.document, "experiment": absolute_reference(form.experiment, self.path.parent)}
        if "fixed" in document:
            paths = {name: value.path for name, value in fixed.items() if isinstance(value, TableFile)}
            document["fixed"] = document["fixed"] | paths
        if form.published is not None:
            file = str((self.path.parent / form.published.file).resolve())
            document["published"] = document["published"] | {"file": file}
        return document

    def _sampling(self, experiment: Experiment, sampling: Sampling) -> None:
        if sampling.keep_samples and experiment.samples is None:
            self._problem(("sampling", "keep_samples"), f"the experiment {experiment.name!r} has no samples to keep")
        if sampling.common_random_numbers and not experiment.shared:
            message = f"no parameter of the experiment {experiment.name!r} is known to leave its random numbers alone"
            self._problem(("sampling", "common_random_numbers"), message)
        if sampling.precision is None:
            if sampling.max_n_sim is not None:
                self._problem(("sampling", "max_n_sim"), "is the limit of a precision, and there is none")
            return
        if sampling.max_n_sim is not None and sampling.max_n_sim < sampling.n_sim:
            message = f"{sampling.max_n_sim}: must be at least n_sim = {sampling.n_sim}, with which every point begins"
            self._problem(("sampling", "max_n_sim"), message)
        if sampling.keep_samples:
            self._problem(("sampling", "precision"), "cannot go with keep_samples: points would keep different numbers")
        if not experiment.errors_of_headline():
            message = f"no headline result X of the experiment {experiment.name!r} has an error X_mc_error to judge by"
            self._problem(("sampling", "precision"), message)

    @cached_property
    def _lines(self) -> dict[Place, int]:
        return lines_of_keys(self.text)

    def _problem(self, where: Place, message: str) -> None:
        if len(self.problems) >= MAX_PROBLEMS:
            raise SweepError([*self.problems, "... and perhaps more problems like these"], str(self.path))
        source = self.overridden.get(where[:2]) or self.overridden.get(where[:1])
        if source is None:
            line = line_of(self._lines, where)
            source = f"line {line}" if line else None
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in where)
        self.problems.append(f"{key}{f' ({source})' if source else ''}: {message}")

    def _form(self) -> _Form | None:
        try:
            return _Form.model_validate(self.document)
        except ValidationError as error:
            for item in error.errors():
                where = tuple(item["loc"])
                if item["type"] == "extra_forbidden":
                    self._problem(where, f"unknown key{suggest(str(where[-1]), _known_keys(where))}")
                elif item["type"] == "missing":
                    self._problem(where, "is required")
                else:
                    self._problem(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown(item['input'])}")
            return self._rest_of_form({item["loc"][0] for item in error.errors()})

    def _rest_of_form(self, broken: set[str | int]) -> _Form | None:
        """Return the form without its broken sections, so that the others are checked too."""
        if "experiment" in broken:
            return None
        if "axes" in broken:
            broken = broken | {"grid", "claim"}
        if "grid" in broken:
            broken = broken | {"claim"}
        rest = {key: value for key, value in self.document.items() if key not in broken}
        return _Form.model_validate({"title": "", **rest})

    def _experiment(self, form: _Form) -> Experiment | None:
        try:
            return load_experiment(form.experiment, self.path.parent)
        except SweepError as error:
            self._problem(("experiment",), str(error))
            return None

    def _fixed(self, experiment: Experiment, form: _Form, name: str, raw: object) -> Value:
        if name in form.axes:
            self._problem(("fixed", name), "is an axis too; leave out one of the two")
        return self._value(experiment, ("fixed", name), name, raw)

    def _value(self, experiment: Experiment, where: tuple[str | int, ...], name: str, raw: object) -> Value:
        try:
            parameter = experiment.parameter(name)
            value = parameter.parse(raw)
            folder = Path.cwd() if where[:2] in self.overridden else self.path.parent
            return table_file(folder / value) if parameter.kind == "file" else value
        except ValueError as error:
            self._problem(where, str(error))
        except SweepError as error:
            self._problem(where, f"{shown(raw)}: {error}")
        return None

    def _axis(self, experiment: Experiment, name: str, spec: object) -> tuple[Value, ...] | None:
        where = ("axes", name)
        try:
            parameter = experiment.parameter(name)
            if parameter.kind in ("vector", "map", "file"):
                raise ValueError(f"a {parameter.kind} cannot be an axis")
            raw_values = axis_values(spec, whole=parameter.kind == "int")
        except ValueError as error:
            self._problem(where, str(error))
            return None
        if not raw_values:
            self._problem(where, "an axis needs at least one value")
        before = len(self.problems)
        values = []
        for raw in raw_values:
            values.append(self._value(experiment, where, name, raw))
            if len(self.problems) >= before + 5:
                self._problem(where, "... and perhaps more values like these")
                return None
        if len(self.problems) > before:
            return None
        repeated = [shown(value) for value, n in Counter(values).items() if n > 1]
        if repeated:
            more = ", ..." if len(repeated) > 10 else ""
            self._problem(where, f"duplicate value{'s' if len(repeated) > 1 else ''} {', '.join(repeated[:10])}{more}")
        return tuple(values)

    def _zip(self, form: _Form, axes: Mapping[str, tuple[Value, ...] | None]) -> tuple[tuple[str, ...], ...]:
        seen: set[str] = set()
        known = [name for name, values in axes.items() if values is not None]  # others may hold control characters
        for i, group in enumerate(form.grid.zip):
            where = ("grid", "zip", i)
            if len(group) < 2:
                self._problem(where, f"{shown(group)}: name at least two axes to walk together")
            for name in group:
                if name not in axes:
                    self._problem(where, f"{shown(name)} is not an axis{suggest(name, known) if known else ''}")
                if name in seen:
                    self._problem(where, f"{shown(name)} is zipped twice")
                seen.add(name)
            lengths = {name: len(values) for name in group if (values := axes.get(name)) is not None}
            if len(set(lengths.values())) > 1:
                sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
                self._problem(where, f"zipped axes must have the same number of values: {sizes}")
        return tuple(tuple(group) for group in form.grid.zip)

    def _exclusion(
        self, experiment: Experiment, form: _Form, index: int, clause: Mapping[str, object]
    ) -> tuple[Condition, ...]:
        if not clause:
            self._problem(("exclude", index), "is empty and would leave out every point")
        return tuple(self._condition(experiment, form, index, name, rule) for name, rule in clause.items())

    def _condition(self, experiment: Experiment, form: _Form, index: int, name: str, rule: object) -> Condition:
        where = ("exclude", index, name)
        try:
            parameter = experiment.parameter(name)
        except ValueError as error:
            self._problem(where, str(error))
            return Condition(name)
        if not isinstance(rule, dict):
            return Condition(name, among=(self._value(experiment, where, name, rule),))
        unknown = [key for key in rule if key not in ("above", "below", "equal", "in")]
        if unknown or not rule:
            wrong = f"unknown condition {shown(unknown)}" if unknown else "has no condition"
            self._problem(where, f"{wrong}; allowed are above, below, equal, in")
            return Condition(name)
        listed = [rule["equal"]] if "equal" in rule else rule.get("in")
        if listed is not None:
            if not isinstance(listed, list) or len(rule) > 1:
                self._problem(where, "'in' takes a list, and 'in' or 'equal' stands alone")
                return Condition(name)
            return Condition(name, among=tuple(self._value(experiment, where, name, raw) for raw in listed))
        if parameter.kind not in ("float", "int"):
            self._problem(where, f"{name} has no order: use equal or in")
        elif parameter.default is None and name not in form.axes and name not in form.fixed:
            self._problem(where, f"{name} has no value to compare: it is neither an axis nor fixed, and has no default")
        bounds: dict[str, float] = {}
        for key, raw in rule.items():
            if not is_number(raw):
                self._problem((*where, key), f"{shown(raw)}: must be a finite number")
            else:
                bounds[key] = float(raw)
        return Condition(name, above=bounds.get("above"), below=bounds.get("below"))

    def _published(
        self, experiment: Experiment, form: _Form, axes: Mapping[str, tuple[Value, ...] | None]
    ) -> Published | None:
        if form.published is None:
            return None
        if (form.published.tolerance is None) != (form.published.tolerance_reason is None):
            message = "a tolerance needs a tolerance_reason, and the other way round"
            self._problem(("published", "tolerance"), message)
        where = ("published", "file")
        file = shown(form.published.file)
        try:
            text = _read(self.path.parent / form.published.file)
        except SweepError as error:
            self._problem(where, f"{file} {error}")
            return None
        lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line and not line.startswith("#")]
        reader = csv.DictReader((line for _, line in lines), restkey="")
        try:
            rows = [(lines[reader.line_num - 1][0], row) for row in reader]
        except csv.Error as error:
            self._problem(where, f"{file} is not a CSV table: {error}")
            return None
        if not rows:
            self._problem(where, f"{file} holds no rows")
            return None
        outputs = {o.name for o in experiment.outputs}
        parameters = {p.name: p for p in experiment.parameters}
        columns = list(reader.fieldnames or ())
        unknown = [column for column in columns if column not in outputs and column not in parameters]
        if unknown:
            self._problem(where, f"{file}: columns {shown(unknown)} are neither parameters nor outputs")
            return None
        for number, row in rows:
            if "" in row or None in row.values():
                self._problem(where, f"{file}, line {number}: does not have {len(columns)} cells as the header has")
                continue
            for column, cell in row.items():
                optional = column in outputs and column not in form.axes
                if wanted := _wrong_cell(parameters.get(column), cell, optional):
                    self._problem(where, f"{file}, line {number}: {column} = {shown(cell)}: must be {wanted}")
        return Published(
            source=form.published.source,
            rows=tuple(row for _, row in rows),
            tolerance=form.published.tolerance or 0.0,
            tolerance_reason=form.published.tolerance_reason or "",
        )

    def _claims(
        self, experiment: Experiment, form: _Form, axes: Mapping[str, tuple[Value, ...] | None]
    ) -> tuple[Claim, ...]:
        changed = frozenset(str(place[1]) for place in self.overridden if place[:1] in (("axes",), ("fixed",)))
        around = Surroundings(experiment, axes, form.grid.zip, changed)
        return tuple(
            checked_claim(claim, around, partial(self._claim_problem, i)) for i, claim in enumerate(form.claim)
        )

    def _claim_problem(self, index: int, place: tuple[str, ...], message: str) -> None:
        self._problem(("claim", index, *place), message)


def _wrong_cell(parameter: Parameter | None, cell: str, optional: bool) -> str | None:
    """Return what a cell of a published table ought to be, or None if it is; an optional one may be empty."""
    if optional and not cell:
        return None
    if parameter is None or parameter.kind in ("float", "int"):
        try:
            number = float(cell)
        except ValueError:
            return "a number" + (" or empty" if optional else "")
        return None if optional or is_number(number) else "a finite number"
    if parameter.kind == "bool":
        return None if cell in ("True", "False") else "True or False"
    return parameter.allowed() if parameter.choices and cell not in parameter.choices else None


def lines_of_keys(text: str) -> dict[Place, int]:
    """Return the 1-based line of every key of a TOML text, as well as it can be told without a parser of lines."""
    table: Place = ()
    counts: dict[str, int] = {}
    lines: dict[Place, int] = {}
    for number, whole in enumerate(text.split("\n"), 1):
        line = whole[:200]  # a key stands at the beginning; the patterns take long on a long line
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(?:#.*)?$", line):
            name = header[2]
            keys = tuple(part.strip(" \"'") for part in name.split("."))
            index = counts[name] = counts.get(name, -1) + 1
            table = (*keys, index) if header[1] == "[[" else keys
            lines[table] = number
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            lines[*table, *entry[1].replace('"', "").replace("'", "").split(".")] = number
    return lines


def line_of(lines: Mapping[Place, int], where: Place) -> int | None:
    """Return the line of a place, or of the innermost table around it that has one."""
    return next((lines[where[:n]] for n in range(len(where), 0, -1) if where[:n] in lines), None)
