"""From a study file to a Study: finds it, reads it, and reports every problem at once."""

import csv
import re
import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from sweep.axes import axis_values, is_number, override
from sweep.contract import Experiment, SweepError, Value, suggest
from sweep.load import absolute_reference, load_experiment
from sweep.study import Condition, Published, Sampling, Section, Study

MAX_FILE_BYTES = 1_000_000


class _Grid(Section):
    zip: list[list[str]] = Field(default_factory=list)


class _Published(Section):
    file: str
    source: str


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


def _known_keys(section: str) -> list[str]:
    sections: dict[str, type[Section]] = {"sampling": Sampling, "grid": _Grid, "published": _Published}
    return list(sections[section].model_fields)


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
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SweepError(f"not valid TOML: {error}", str(path)) from error
    problems: list[str] = []
    for setting in settings:
        override(document, setting, problems, as_axis=False)
    for axis in axes:
        override(document, axis, problems, as_axis=True)
    overrides = tuple([f"--set {s}" for s in settings] + [f"--axis {a}" for a in axes])
    return _Reader(document, text, path, problems, overrides).study()


def study_from_dict(document: Mapping[str, Any], name: str = "study") -> Study:
    """Return the study that a mapping of the same shape as the TOML file describes; raises SweepError as
    `load_study`.
    """
    return _Reader(dict(document), "", Path.cwd() / f"{name}.toml", [], ()).study()


def _find(name_or_path: str) -> Path:
    built_in = built_in_studies()
    if name_or_path in built_in:
        return built_in[name_or_path]
    path = Path(name_or_path)
    if path.is_dir():
        raise SweepError(f"{name_or_path} is a directory, not a study file")
    if not path.exists():
        hint = "" if path.suffix else suggest(name_or_path, list(built_in))
        raise SweepError(f"no study {name_or_path!r}: neither a file nor a built-in study{hint}")
    return path


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise SweepError(f"the study file is larger than {MAX_FILE_BYTES:,} bytes", str(path))
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SweepError(f"not UTF-8 text: {error}", str(path)) from error
    except OSError as error:
        raise SweepError(f"cannot be read: {error.strerror}", str(path)) from error


class _Reader:
    """Reads one document into a Study, gathering every problem on the way."""

    def __init__(
        self, document: dict[str, Any], text: str, path: Path, problems: list[str], overrides: tuple[str, ...]
    ) -> None:
        self.document, self.text, self.path, self.problems, self.overrides = document, text, path, problems, overrides

    def study(self) -> Study:
        form = self._form()
        experiment = None if form is None else self._experiment(form)
        if form is None or experiment is None:
            raise SweepError(self.problems, str(self.path))
        axes = {name: self._axis(experiment, name, spec) for name, spec in form.axes.items()}
        fixed = {name: self._fixed(experiment, form, name, raw) for name, raw in form.fixed.items()}
        zipped = self._zip(form, axes)
        excluded = tuple(self._exclusion(experiment, i, clause) for i, clause in enumerate(form.exclude))
        published = self._published(experiment, form, axes)
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
            text=self.text,
            overrides=self.overrides,
        )

    def _problem(self, where: tuple[str | int, ...], message: str) -> None:
        line = line_of(self.text, where)
        key = ".".join(str(part) for part in where)
        self.problems.append(f"{key}{f' (line {line})' if line else ''}: {message}")

    def _form(self) -> _Form | None:
        try:
            return _Form.model_validate(self.document)
        except ValidationError as error:
            for item in error.errors():
                where = tuple(item["loc"])
                if item["type"] == "extra_forbidden":
                    known = _known_keys(str(where[0])) if len(where) > 1 else list(_Form.model_fields)
                    self._problem(where, f"unknown key{suggest(str(where[-1]), known)}")
                elif item["type"] == "missing":
                    self._problem(where, "is required")
                else:
                    shown = repr(item["input"])
                    self._problem(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown[:60]}")
            return None

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
            return experiment.parameter(name).parse(raw)
        except ValueError as error:
            self._problem(where, str(error))
            return None

    def _axis(self, experiment: Experiment, name: str, spec: object) -> tuple[Value, ...] | None:
        where = ("axes", name)
        try:
            parameter = experiment.parameter(name)
            if parameter.kind == "vector":
                raise ValueError("a vector cannot be an axis")
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
        repeated = sorted({str(v) for v in values if values.count(v) > 1}) if len(set(values)) < len(values) else []
        if repeated:
            self._problem(where, f"duplicate value{'s' if len(repeated) > 1 else ''} {', '.join(repeated)}")
        return tuple(values)

    def _zip(self, form: _Form, axes: Mapping[str, tuple[Value, ...] | None]) -> tuple[tuple[str, ...], ...]:
        seen: set[str] = set()
        for i, group in enumerate(form.grid.zip):
            where = ("grid", "zip", i)
            if len(group) < 2:
                self._problem(where, f"{group}: name at least two axes to walk together")
            for name in group:
                if name not in axes:
                    self._problem(where, f"{name!r} is not an axis{suggest(name, list(axes)) if axes else ''}")
                if name in seen:
                    self._problem(where, f"{name!r} is zipped twice")
                seen.add(name)
            lengths = {name: len(values) for name in group if (values := axes.get(name)) is not None}
            if len(set(lengths.values())) > 1:
                sizes = ", ".join(f"{name} has {n}" for name, n in lengths.items())
                self._problem(where, f"zipped axes must have the same number of values: {sizes}")
        return tuple(tuple(group) for group in form.grid.zip)

    def _exclusion(self, experiment: Experiment, index: int, clause: Mapping[str, object]) -> tuple[Condition, ...]:
        if not clause:
            self._problem(("exclude", index), "is empty and would leave out every point")
        return tuple(self._condition(experiment, ("exclude", index, name), name, rule) for name, rule in clause.items())

    def _condition(self, experiment: Experiment, where: tuple[str | int, ...], name: str, rule: object) -> Condition:
        if not isinstance(rule, dict):
            return Condition(name, among=(self._value(experiment, where, name, rule),))
        unknown = [key for key in rule if key not in ("above", "below", "equal", "in")]
        if unknown or not rule:
            self._problem(where, f"unknown condition {unknown}; allowed are above, below, equal, in")
            return Condition(name)
        listed = [rule["equal"]] if "equal" in rule else rule.get("in")
        if listed is not None:
            if not isinstance(listed, list) or "above" in rule or "below" in rule or ("in" in rule and "equal" in rule):
                self._problem(where, "'in' takes a list, and 'in' or 'equal' stands alone")
                return Condition(name)
            return Condition(name, among=tuple(self._value(experiment, where, name, raw) for raw in listed))
        bounds: dict[str, float] = {}
        for key, raw in rule.items():
            if not is_number(raw):
                self._problem((*where, key), f"{raw!r}: must be a finite number")
            else:
                bounds[key] = float(raw)
        try:
            if experiment.parameter(name).kind not in ("float", "int"):
                self._problem(where, f"{name} has no order: use equal or in")
        except ValueError as error:
            self._problem(where, str(error))
        return Condition(name, above=bounds.get("above"), below=bounds.get("below"))

    def _published(
        self, experiment: Experiment, form: _Form, axes: Mapping[str, tuple[Value, ...] | None]
    ) -> Published | None:
        if form.published is None:
            return None
        where = ("published", "file")
        try:
            text = (self.path.parent / form.published.file).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            self._problem(where, f"{form.published.file!r} cannot be read: {error}")
            return None
        rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
        known = [*(p.name for p in experiment.parameters), *(o.name for o in experiment.outputs)]
        unknown = sorted({str(column) for row in rows for column in row} - set(known))
        if unknown or not rows:
            self._problem(where, f"columns {unknown} are neither parameters nor outputs" if rows else "holds no rows")
            return None
        return Published(source=form.published.source, rows=tuple(rows))


def line_of(text: str, where: tuple[str | int, ...]) -> int | None:
    """Return the 1-based line on which a key of a TOML text stands, as well as it can be told without a parser of
    lines.
    """
    table: tuple[str | int, ...] = ()
    counts: dict[str, int] = {}
    best = None
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*(\[\[?)\s*([^\]]+?)\s*\]", line):
            name = header[2].strip("\"'")
            index = counts[name] = counts.get(name, -1) + 1
            table = (name, index) if header[1] == "[[" else tuple(name.split("."))
            here = table
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            here = (*table, *entry[1].replace('"', "").replace("'", "").split("."))
        else:
            continue
        if here == where[: len(here)] and len(here) > 0 and (best is None or len(here) >= best[0]):
            best = (len(here), number)
    return best[1] if best else None
