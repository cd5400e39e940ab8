"""From a study file, a function or a mapping, and the options of the command line that change it, to a Study: reads all
of it, and reports every problem at once.
"""

import csv
import hashlib
import inspect
import json
import os
import re
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from linksweep.sweep.code import Code, SourceFunction, absolute_reference, defined_twice, keep
from linksweep.sweep.contract import DefinitionError, Experiment, Named, SweepError, Value, refused, shown, suggest
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.functions.adapter import name_of
from linksweep.sweep.studies import built_in_studies
from linksweep.sweep.studies.points import (
    KeyPath,
    Problems,
    Values,
    compared,
    labelled,
    parse_value,
    plain_study,
    read_cell,
    read_points,
    with_labels,
)
from linksweep.sweep.studies.study import DEFAULT_EXPERIMENT, Condition, Context, Form, Part, Published, Sampling, Study

MAX_FILE_BYTES = 1_000_000

# The most parts of a dotted key: the parser's time grows with their square, to minutes for a long line of them.
DEEPEST = 100

# ``file.py:NAME`` and ``module:NAME``.
REFERENCE = re.compile(r"(?P<place>[^:\n]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*")


def reference_in(name_or_path: str) -> str | None:
    """Return the argument if it is a reference, ``file.py:NAME`` or ``module:NAME``; None for a file or other name."""
    match = REFERENCE.fullmatch(name_or_path)
    return None if match is None or Path(name_or_path).exists() else name_or_path


def find_study(name_or_path: str) -> Path:
    """Return the file of a built-in name or a path; raises SweepError where there is none."""
    built_in = built_in_studies()
    if name_or_path not in built_in and not os.path.exists(name_or_path):
        files = [str(path) for end in ("toml", "py") for path in Path(name_or_path).parent.glob(f"*.{end}")]
        hint = suggest(name_or_path, [*built_in, *files])
        raise SweepError(f"no study {shown(name_or_path)}: neither a file nor a built-in study{hint}")
    if os.path.isdir(name_or_path):
        raise SweepError("is a folder, not a study; for a store there is `sweep run --retry STORE`", name_or_path)
    return built_in.get(name_or_path, Path(name_or_path))


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size; raises SweepError where it cannot be read or is no UTF-8."""
    with refused(OSError, ValueError, said="cannot be read: ", where=path), path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)  # no stat: a device or a pipe has no size
    if len(content) > MAX_FILE_BYTES:
        raise SweepError(f"is larger than {MAX_FILE_BYTES:,} bytes", str(path))
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise SweepError(f"not UTF-8 text: byte 0x{content[error.start]:02x} in line {line}", str(path)) from error


def parsed(text: str, path: Path) -> dict[str, Any]:
    """Return the document of a TOML text; raises SweepError where it is not valid."""
    if path.suffix == ".py":
        raise SweepError(f"is Python, not a study; name a function in it, as {path}:NAME", str(path))
    # of what may be a key: texts with many dots are none
    tokens = (token for token in re.findall(r"[^,=\[\]{}#\n]+", text) if token.count(".") > DEEPEST)
    with refused(ValueError, RecursionError, said="not valid TOML: ", where=path):
        if any(len(re.findall(r"[\w\"'-]\s*\.\s*(?=[\w\"'-])", token)) > DEEPEST for token in tokens):
            raise RecursionError("nested too deeply")
        return tomllib.loads(text)


@dataclass
class Overrides:
    """The options of the command line that change a study, pairs of a flag and its text, None where no text is written;
    ``by_place`` says which of them gave the value at a place of the document.
    """

    written: Sequence[tuple[str, str]] | None = None
    by_place: dict[KeyPath, str] = field(default_factory=dict)
    folder: Path = field(default_factory=Path.cwd)  # before a study is read, whose code may change it

    def apply(
        self, document: dict[str, Any], parameters: Collection[str], texts: Collection[str], problems: list[str]
    ) -> None:
        """Change a document; ``parameters`` are those that are meant although a key of [sampling] has their name, and
        ``texts`` those whose values are texts.

        The conclusion is removed where the points change, or parameters that the study fixes: it is about these.
        """
        points, axes = (table if isinstance(table := document.get(key), dict) else {} for key in ("points", "axes"))
        other = {"axes": "fixed", "fixed": "axes"}
        written = self.written or ()
        flags = {flag for flag, _ in written}
        if flags & {"--points", "--design"}:
            kept = () if "--points" in flags else ("seed", "ranges")
            document["points"] = {key: points[key] for key in kept if key in points}
        slots: dict[KeyPath, str] = {}  # of two options that set the same, one would be lost
        for flag, text in written:
            option = f"{flag} {text if text.isprintable() and len(text) <= 80 else shown(text)}"
            try:
                file: dict[KeyPath, Any] = {("points", "file"): str(self.folder / text)}
                values = file if flag == "--points" else _values_of(flag, text, parameters, texts)
            except SweepError as error:
                problems.append(f"{flag} {shown(text)}: {error}")
                continue
            for place, value in values.items():
                slot = ("fixed", *place[1:]) if place[0] == "axes" else place  # a parameter has one place
                if (earlier := slots.setdefault(slot, option)) != option:
                    problems.append(f"{earlier} and {option}: {place[-1]} is given twice; leave out one of the two")
                self.by_place[place] = option
                if flag in ("--points", "--design", "--range"):  # the table is theirs
                    self.by_place.setdefault(("points",), option)
                if place[0] in ("points", "fixed", "exclude") or (place[0] == "axes" and place[1] not in axes):
                    document.pop("conclusion", None)
                # an option decides whether a parameter is an axis or fixed, whatever the file says
                if isinstance(elsewhere := document.get(other.get(str(place[0]), "")), dict):
                    elsewhere.pop(place[1], None)
                _put(document, place, value)


def _put(document: dict[str, Any], place: KeyPath, value: Any) -> None:
    """Set a value of a document, unless it is to be in what is no table: reading the document will say so."""
    if place[0] == "exclude":
        if isinstance(clauses := document.setdefault("exclude", []), list):
            document["exclude"] = [*clauses, value]
        return
    *tables, key = map(str, place)
    for table in tables:
        document = document.setdefault(table, {})
        if not isinstance(document, dict):
            return
    document[key] = value


def _values_of(flag: str, text: str, parameters: Collection[str], texts: Collection[str]) -> dict[KeyPath, Any]:
    """Return the values that an option sets, by their places; raises SweepError that says how it is written."""
    if flag == "--design":
        name, *numbers = text.split(":")
        if len(numbers) > 2:
            raise SweepError("must be written NAME:N or NAME:N:SEED")
        seed_too = zip(("n", "seed"), map(parse_value, numbers), strict=False)
        return {("points", "design"): name, **{("points", key): number for key, number in seed_too}}
    if flag == "--exclude":
        return {("exclude", text): _conditions(text, texts)}
    key, value = split_assignment(text)
    if not key:
        ways = {"--axis": "NAME=SPEC", "--range": "NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C"}
        raise SweepError(f"must be written {ways.get(flag, 'KEY=VALUE')}")
    if flag != "--set":
        place = ("axes", key) if flag == "--axis" else ("points", "ranges", key)
        return {place: (parse_axis if flag == "--axis" else parse_range)(value, is_text=key in texts)}
    if key == "title":
        return {(key,): value}
    table, _, name = key.partition(".")
    if table not in ("fixed", "points", "sampling") or not name:
        table, name = "sampling" if key in Sampling.model_fields and key not in parameters else "fixed", key
    return {(table, name): parse_value(value, is_text=name in texts and table == "fixed")}


def _conditions(text: str, texts: Collection[str]) -> dict[str, Any]:
    """Return an entry of [[exclude]] written as ``kernel=linear,gamma>1``."""
    conditions: dict[str, Any] = {}
    for part in text.split(","):
        condition = re.fullmatch(r"\s*([\w.-]+)\s*(==|[=<>])\s*([^=<>].*?)\s*", part)
        if condition is None or (condition[2] in ("=", "==") and condition[1] in conditions):
            raise SweepError("must be written NAME=VALUE, NAME>NUMBER or NAME<NUMBER, several with commas between them")
        value = parse_value(condition[3], is_text=condition[1] in texts)
        rule = {"<": "below", ">": "above"}.get(condition[2])
        conditions[condition[1]] = value if rule is None else {**conditions.get(condition[1], {}), rule: value}
    return conditions


def parse_axis(text: str, is_text: bool = False) -> Any:
    """Return an axis: ``14:20:0.5`` is a range with a step, ``10:1000:log5`` five values in equal ratios, ``0:1:lin5``
    five with equal steps, anything else a list.

    >>> parse_axis("14:20:0.5")
    {'start': 14, 'stop': 20, 'step': 0.5}
    >>> parse_axis("amex,'12:30:00'")
    ['amex', '12:30:00']
    """
    first, *parts = text.split(":")
    if parts and not is_text and not isinstance(start := parse_value(first), str):
        if len(parts) != 2:
            raise SweepError(f"{shown(text)}: a range is START:STOP:STEP, or START:STOP:log5; texts are in quotes")
        ends, spacing = {"start": start, "stop": parse_value(parts[0])}, parts[1][:3]
        if spacing in ("log", "lin"):
            return {**ends, "num": parse_value(parts[1][3:]), **({"spacing": "log"} if spacing == "log" else {})}
        return {**ends, "step": parse_value(parts[1])}
    listed = parse_value(text)
    return listed if isinstance(listed, list) else _split(text, is_text)


def _split(text: str, is_text: bool = False) -> list[Any]:
    """Return values with commas between them; raises SweepError where a comma would cut a text in quotes or a list."""
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        is_cut = part[:1] in ("'", '"') and (len(part) == 1 or part[-1] != part[0])
        if is_cut or (len(parts) > 1 and any(part.count(one) > part.count(end) for one, end in ("[]", "()", "{}"))):
            raise SweepError(f'{shown(part)}: commas divide values; those with commas are written ["a,b", [1, 2]]')
    return [parse_value(part, is_text) for part in parts]


def parse_range(text: str, is_text: bool = False) -> Any:
    """Return a range: ``0.1:0.5`` on a linear scale, ``1:100:log`` on a logarithmic one, anything else as a list.

    >>> parse_range("1:100:log"), parse_range("amex,gaia")
    ({'low': 1, 'high': 100, 'spacing': 'log'}, {'values': ['amex', 'gaia']})
    """
    parts = text.split(":")
    if len(parts) not in (2, 3) or is_text:
        return {"values": _split(text, is_text)}
    spacing = {"spacing": parts[2]} if len(parts) == 3 else {}
    return {"low": parse_value(parts[0]), "high": parse_value(parts[1]), **spacing}


def parse_places(texts: Sequence[str]) -> dict[str, str]:
    """Return values of axes by name, from texts like "model=gaia,v_max=16"; values may have commas.

    Raises SweepError that lists what is wrong.
    """
    places: dict[str, str] = {}
    problems = []
    # D(a=1, b=2) is the label of an object
    for part in (part for text in texts for part in re.split(r",(?=\s*[\w.+-]+\s*=)(?![^(]*\))", text)):
        name, value = split_assignment(part)
        if not name:
            problems.append(f"{shown(part)}: a place is AXIS=VALUE, several with commas between them")
        elif places.setdefault(name, value) != value:
            problems.append(f"{name} is given twice, as {places[name]} and {value}")
    if problems:
        raise SweepError(problems, "--at")
    return places


# The sampling of a deterministic experiment, which is evaluated once at each point.
ONCE = Sampling(n_sim=1)

# Names that can be written on the command line wherever it takes a value of an axis.
GOOD_NAME = re.compile(r"[A-Za-z_][\w.+-]{0,59}", re.ASCII)

# The sections that a store has as they are written.
SECTIONS = ("title", "question", "define", "when", "published", "claim", "conclusion", "figure")

# The sections that are read again, at last: they are about the axes and the experiment.
STATEMENTS = ("sampling", "grid", "exclude", "claim", "conclusion", "figure")

# Characters of the beginning of a docstring that is a title.
LONGEST_TITLE = 120

Mentioned = Callable[..., Any] | Experiment


def load_study(
    name_or_path: str | Path,
    settings: Sequence[str] = (),
    axes: Sequence[str] = (),
    points: str | None = None,
    design: str | None = None,
    ranges: Sequence[str] = (),
    exclude: Sequence[str] = (),
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
        exclude: ``NAME=VALUE,NAME>NUMBER``, points that are left out, as in ``sweep run --exclude``.

    Returns:
        The study; all its parameters have values that the experiment allows.

    Raises:
        SweepError: with all problems, each with its key and, if it has one, its line in the file.

    Example:
        >>> study = load_study("quasars", settings=["n_sim=50"], axes=["v_max=14:16:0.5"])
        >>> study.axes["v_max"], study.sampling.n_sim
        ((14.0, 14.5, 15.0, 15.5, 16.0), 50)
    """
    name_or_path = os.fspath(name_or_path)
    if (function := reference_in(name_or_path)) is not None:
        path, text = Path.cwd() / f"{function.rpartition(':')[2]}.toml", ""
        document: dict[str, Any] = {"title": path.stem, "experiment": function}
    else:
        path = find_study(name_or_path)
        text = read_text(path)
        document = parsed(text, path)
    by_flag = {"--set": settings, "--axis": axes, "--points": [points], "--design": [design]}
    by_flag |= {"--range": ranges, "--exclude": exclude}
    written = [(flag, text) for flag, texts in by_flag.items() for text in texts if text is not None]
    return _Reader(document, text, path.absolute(), function or str(path), Overrides(written), Code()).study()


def study_of_attributes(attributes: Mapping[str, Any], where: str, code: Code) -> Study:
    """Return the study whose results have these attributes; raises SweepError as `load_study`, for example where the
    file of its experiment is gone.

    All that it names is loaded by ``code`` or not at all.  Published numbers are left out if their file is gone.
    """
    try:
        document = json.loads(attributes["study_document"])
        text, overrides, name = (str(attributes[key]) for key in ("study", "study_overrides", "study_name"))
        part = Part.recorded(attributes)
    except (KeyError, TypeError, ValueError) as error:
        raise SweepError("does not say which study it holds", where) from error
    if "published" in document and not Path(document["published"]["file"]).is_file():
        del document["published"]
    options = Overrides()
    if overrides:  # which of its parameters they changed is not known
        options.by_place |= {(table, key): "" for table in ("axes", "fixed") for key in document.get(table, {})}
        options.by_place[("points",)] = ""
    study = _Reader(document, text, Path(where), where, options, code).study()
    of_function = {"title": attributes["title"], "description": attributes.get("description", "")}  # of its docstring
    return replace(study, name=name, overrides=(overrides,) if overrides else (), part=part, **of_function)


def study_of_function(function: Mentioned | str, **options: Any) -> Study:
    """Return the study of a function, named after it, with those ``options`` of `linksweep.run` that are about a study;
    raises SweepError as `load_study`.
    """
    tables = ("axes", "fixed", "sampling", "when")  # which may be empty
    document = {key: some for key, some in options.items() if some is not None and (key not in tables or some)}
    if "labels" in document:
        document["points"] = with_labels(document.get("points"), document.pop("labels"))
    return live_study({"experiment": function, **document})


def live_study(document: Mapping[str, Any]) -> Study:
    """Return the study that a mapping of the shape of a study file describes; raises SweepError as `load_study`.

    Its experiment may be a function or an `Experiment`, its axes may be arrays, ranges or pandas indexes, its points a
    table, and it needs no title.  Two such studies have the same name only where they are about the same function and
    say the same.
    """
    function = document.get("experiment", DEFAULT_EXPERIMENT)
    written = plain_study({key: value for key, value in document.items() if key != "experiment"})
    if isinstance(function, str):
        written["experiment"], name = function, function.rpartition(":")[2]
    elif isinstance(function, Experiment) or callable(function):
        written["experiment"] = keep(function)
        name = function.name if isinstance(function, Experiment) else name_of(function)
    else:
        raise SweepError(f"{shown(function)} is neither a function nor an Experiment")
    written.setdefault("title", name)
    digest = ""
    # Of an integer that Python does not print, or an object without a label, which are refused by name below.
    with suppress(ValueError):
        known = json.dumps(written, sort_keys=True, default=lambda one: repr(labelled(one, otherwise="object")))
        digest = hashlib.sha256(known.encode()).hexdigest()
    path, code = Path.cwd() / f"{name}-{digest[:8]}.toml", Code(afresh=isinstance(function, str))
    return _Reader(written, "", path, "", Overrides(), code).study()


class _Reader:
    """Reads one document into a Study, gathering every problem on the way."""

    def __init__(
        self, document: dict[str, Any], text: str, path: Path, where: str, options: Overrides, code: Code
    ) -> None:
        self.document, self.text, self.path, self.where = document, text, path, where
        self.folder, self.options, self.code = path.parent, options, code
        self.problems = Problems(where, text, options.by_place)
        self.loaded: dict[str, str] = {}  # references to functions of definitions, as they work from any directory

    def study(self) -> Study:
        problems = self.problems
        # Definitions before values, which may be defined; points before axes and what is fixed, which may repeat them;
        # and last what is said of all these.
        form, experiment, broken = self._form_and_experiment()
        experiment = self._defined(experiment, form.define)
        when = {one.name: one.when for one in experiment.parameters if one.when} | form.when
        values = Values(experiment.with_setting("when", when), self.folder, problems)
        experiment = values.experiment
        points, table = read_points(form, values, self.code)
        crossed = {name: values.axis(name, spec) for name, spec in form.axes.items()}
        axes, fixed = {**points, **crossed}, dict[str, Value]()
        for name, raw in form.fixed.items():
            if name in form.axes:
                problems.add(("fixed", name), "is an axis too; leave out one of the two")
            fixed[name] = values.one(("fixed", name), name, raw)
        conditions, zipped = self._conditions(values, when), tuple(map(tuple, form.grid.zip))
        values_of = {name: some or () for name, some in axes.items()}
        draft = Study("", "", "", experiment, values_of, fixed, ONCE, zipped, table, when=conditions)
        crossed = {name: draft.places[name] or None for name in crossed}
        required = {one.name for one in experiment.parameters if not one.optional and one.default is not None}
        for name in required.intersection(draft.lacking):  # where None can only mean that there is no effect
            axes[name] = tuple(value for value in axes[name] or () if value is not None) or axes[name]
        if points or "points" not in self.document:  # else the table is wrong: what it has is not known
            for name in (one.name for one in experiment.parameters if one.required):
                if name not in {**axes, **fixed}:
                    words = f"{name} has no default: set it here (--set {name}=VALUE) or in axes (--axis)"
                    problems.add(("fixed", name), words)
        written = {one.name: one.written for one in experiment.parameters}
        when = {n: {c.name: written[c.name](c.among) for c in some if c.among} for n, some in conditions.items()}
        self.document |= {"when": {name: when.get(name) for name in form.when}} if form.when else {}
        experiment = self._with_labels(experiment, axes, fixed, when)
        published = _read_published(form, values, axes, fixed)
        changed = frozenset(str(place[1]) for place in problems.options if place[0] in ("axes", "fixed"))
        columns = dict.fromkeys(points) if ("points",) in problems.options else points
        context = Context(experiment, crossed, zipped, frozenset({*axes, *fixed}), changed, compared, columns)
        checked = form
        if not broken & {"axes", "points"}:
            statements = {key: self.document[key] for key in STATEMENTS if key in self.document.keys() - broken}
            checked, _ = _read_form({"title": "", **statements}, problems, context)
        problems.report()
        call = getattr(experiment, "call", None)
        docstring = (inspect.isfunction(call) and inspect.getdoc(call)) or ""
        summary, *rest = re.split(r"(?<=[.!?])\s+(?=[A-Z])|\n\n", docstring, maxsplit=1)
        summary = " ".join(summary.split()).rstrip(".")
        if len(summary) > LONGEST_TITLE or not summary.isprintable() or form.title != experiment.name:
            summary, rest = "", [docstring]  # a terminal would take some of it for something else
        return Study(
            name=self.path.stem,
            title=summary or form.title,
            description="".join(rest).strip("\n"),
            question=form.question or "",
            experiment_reference=absolute_reference(form.experiment, self.folder),
            experiment=experiment.keeping_samples() if checked.sampling.keep_samples else experiment,
            axes={name: one for name, one in axes.items() if one is not None},
            fixed=fixed,
            sampling=ONCE if experiment.deterministic else checked.sampling,
            zipped=zipped,
            points=table,
            excluded=tuple(tuple(clause.values()) for clause in checked.exclude),
            counts=form.counts,
            when=conditions,
            published=published,
            source=self.where,
            claims=tuple(checked.claim),
            conclusion=checked.conclusion,
            text=self.text,
            overrides=tuple(f"{flag} {text}" for flag, text in self.options.written or ()),
            sections=self._portable(form),
        ).settled()

    def _conditions(
        self, values: Values, when: Mapping[str, Mapping[str, Sequence[Any]]]
    ) -> dict[str, tuple[Condition, ...]]:
        """Return the conditions under which parameters have an effect, those that others depend on first."""
        conditions: dict[str, tuple[Condition, ...]] = {}
        for name, by_name in when.items():
            place = ("when", name)
            with self.problems.at(place):
                values.experiment.parameter(name)
            conditions[name] = tuple(
                Condition(other, values.several((*place, other), other, some) or ()) for other, some in by_name.items()
            )
        try:
            return {name: conditions[name] for name in TopologicalSorter(when).static_order() if name in when}
        except CycleError as error:
            self.problems.add(("when",), f"the effect of {error.args[1][0]} cannot depend on its own value")
            return {}

    def _with_labels(
        self,
        experiment: Experiment,
        axes: Mapping[str, tuple[Value, ...] | None],
        fixed: Mapping[str, Value],
        when: Mapping[str, Mapping[str, Sequence[Value]]],
    ) -> Experiment:
        """Return the experiment with the objects that the study gives its parameters, each under one label, and with
        the conditions under which they have an effect.
        """
        objects: dict[str, tuple[Named, ...]] = {}
        for parameter in experiment.parameters:
            name = parameter.name
            place = "axes" if name in axes else "fixed", name
            values = (*parameter.defined, *(axes.get(name) or ()), *([fixed[name]] if name in fixed else []))
            if parameter.takes_objects or parameter.optional:
                with self.problems.at(place):
                    Values.require_labels(values)
            objects[name] = tuple({one.name: one for one in values if isinstance(one, Named)}.values())
        reference = absolute_reference(str(self.document.get("experiment", DEFAULT_EXPERIMENT)), self.folder)
        for name, said in defined_twice(reference, objects):
            self.problems.add(("axes" if name in axes else "fixed", name), said)
        return experiment.with_setting("defined", objects).with_setting("when", when)

    def _form_and_experiment(self) -> tuple[Form, Experiment, set[str | int]]:
        """Return the document, as the options have changed it, without broken sections, so that the others are checked
        too; its experiment; and which sections are broken.
        """
        experiment = None
        reference = self.document.get("experiment", DEFAULT_EXPERIMENT)
        if isinstance(reference, str):  # else the form says what is wrong
            with self.problems.at(("experiment",)):
                experiment = self.code.experiment(reference, self.folder)
        # Without sampling, --set seed=3 means a parameter of that name.
        is_sampled = experiment is None or not experiment.deterministic
        names = [] if experiment is None or is_sampled else [one.name for one in experiment.parameters]
        texts = [] if experiment is None else [one.name for one in experiment.parameters if one.kind == "str"]
        published, fixed = (self.document.get(key) for key in ("published", "fixed"))
        if isinstance(published, dict) and isinstance(fixed, dict):  # as it is before any option
            plain = {name: raw for name, raw in fixed.items() if isinstance(raw, int | float | str)}
            where = published.get("where", {})
            self.document["published"] = published | {"where": plain | where if isinstance(where, dict) else where}
        self.options.apply(self.document, names, texts, self.problems.sentences)
        if self.options.written is not None and experiment is not None:
            known = {one.name for one in experiment.parameters if one.reads_none}
            self.document |= {k: _with_none(one, known) for k, one in self.document.items() if k != "define"}
        form, broken = _read_form(self.document, self.problems)
        if experiment is None:
            self.problems.report()
        assert experiment is not None, "that there is none is a problem"
        return form, experiment, broken

    def _portable(self, form: Form) -> dict[str, Any]:
        """Return the sections that a store has as they are written, with references and files that work from any
        directory.
        """
        sections = {key: self.document[key] for key in SECTIONS if key in self.document}
        sections |= {"define": self._absolute(form.define)} if form.define else {}
        if form.published is not None:
            sections["published"] = sections["published"] | {"file": str((self.folder / form.published.file).resolve())}
        return sections

    def _absolute(self, raw: Any) -> Any:
        if isinstance(raw, dict):
            return {key: self._absolute(one) for key, one in raw.items()}
        return self.loaded.get(raw, raw) if isinstance(raw, str) else raw

    def _defined(self, experiment: Experiment, tables: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Experiment:
        """Return the experiment with the values that the tables [define.PARAMETER.NAME] define."""
        defined: dict[str, tuple[Named, ...]] = {}
        for name, by_name in tables.items():
            with self.problems.at(("define", name, *list(by_name)[:1])):
                parameter = experiment.parameter(name)
                if parameter.define is None:
                    raise ValueError(f"{name} takes no values that a study defines, but {parameter.allowed()}")
                for word in by_name:
                    if not GOOD_NAME.fullmatch(word):
                        rule = "a name begins with a letter and has at most 60 letters, digits and any of _ . + -"
                        self.problems.add(("define", name, word), rule)
                    if word in parameter.choices:
                        taken = f"{shown(word)} is there already; take another name"
                        self.problems.add(("define", name, word), taken)
                makes = parameter.define
                defined[name] = tuple(self._named(makes, ("define", name, word), by_name[word]) for word in by_name)
        return experiment.with_setting("defined", defined)

    def _named(self, define: Callable[..., Any], place: tuple[str, str, str], table: Mapping[str, Any]) -> Named:
        """Return the value that a table defines, with the functions that it names."""
        name = place[2]
        try:
            value, identity = define(table, self._load)
            return Named(name, json.dumps(identity, sort_keys=True), value)
        except DefinitionError as error:
            for key, sentence in error.problems:
                self.problems.add((*place, key) if key else place, sentence)
        except Exception as error:  # whatever a user's experiment raises
            said = f"{type(error).__name__}: {error}"
            self.problems.add(place, f"the experiment cannot make anything of it: {said}")
        return Named(name, name, None)  # so that its name is known where it is used

    def _load(self, reference: str) -> SourceFunction:
        function = self.code.function(reference, self.folder)
        self.loaded[reference] = function.reference
        return function


def problems_of_results(study: Study) -> list[str]:
    """Return what is wrong in what a study says of results, once it is known which there are."""
    problems = Problems(study.source, study.text)
    figure = {key: some for key, some in study.sections.get("figure", {}).items() if key != "at"}
    context = Context(study.experiment, {}, (), frozenset(), frozenset())
    _read_form({"title": "", "figure": figure}, problems, context)
    outputs = (*study.experiment.outputs, *study.experiment.sample_outputs)
    for name in study.points.labels if study.points else ():
        if any(name == output.name or name in output.dims for output in outputs):
            words = f"{name} is a label and the name of a result or its dimension: rename the column"
            problems.add(("points", "labels"), words)
    return problems.sentences


def _with_none(raw: Any, names: Collection[str], here: bool = False) -> Any:
    """Return a part of a written study with None for the text None at parameters with some ``names``, and ``here``."""
    if isinstance(raw, dict):
        deeper = {*names, *(("values", "equal", "in") if here else ())}
        return {key: _with_none(one, names, key in deeper) for key, one in raw.items()}
    if isinstance(raw, list):
        return [_with_none(one, names, here) for one in raw]
    return None if here and raw == "None" else raw


def _read_form(
    document: Mapping[str, Any], problems: Problems, context: Context | None = None
) -> tuple[Form, set[str | int]]:
    """Return a document with its sections checked, without those that are broken, and which these are; ``problems``
    takes what is wrong.
    """
    try:
        return Form.model_validate(document, context=context), set()
    except ValidationError as error:
        for item in error.errors():
            where = tuple(item["loc"])
            if item["type"] == "extra_forbidden":
                problems.add(where, f"unknown key{suggest(str(where[-1]), _known_keys(where))}")
            elif item["type"] == "missing":
                problems.add(where, "is required")
            elif item["type"] == "value_error":
                problems.add(where, str(item["ctx"]["error"]))
            else:
                problems.add(where, f"{item['msg'][0].lower()}{item['msg'][1:]}, not {shown(item['input'])}")
        broken = {item["loc"][0] for item in error.errors()}
        whole = {key: section for key, section in document.items() if key not in broken}
        return Form.model_validate({"title": "", **whole}, context=context), broken


def _known_keys(where: KeyPath) -> list[str]:
    """Return the keys that are allowed beside the one at a place."""
    table: type[BaseModel] = Form
    for key in where[:-1]:
        field = table.model_fields.get(str(key))
        if field is not None:  # the one model in types such as Slope | None, list[Claim] and dict[str, ConclusionValue]
            todo: list[Any] = [field.annotation]
            for one in todo:  # which grows meanwhile
                todo += getattr(one, "__args__", ())
            table = next((one for one in todo if isinstance(one, type) and issubclass(one, BaseModel)), table)
    return list(table.model_fields)


def _read_published(form: Form, values: Values, axes: Collection[str], fixed: Mapping[str, Value]) -> Published | None:
    """Return the published numbers that a study names, if any, from a CSV file in its folder."""
    if (about := form.published) is None:
        return None
    problems, file, where = values.problems, shown(about.file), ("published", "file")
    with problems.at(where, f"{file} "):
        text = read_text(values.folder / about.file)
        lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line and not line.startswith("#")]
        reader = csv.DictReader((line for _, line in lines), restkey="")
        with refused(csv.Error, said="is not a CSV table: "):
            rows = [(lines[reader.line_num - 1][0], row) for row in reader]
        outputs = {output.name for output in values.experiment.outputs}
        parameters = {parameter.name: parameter for parameter in values.experiment.parameters}
        if not rows:
            raise ValueError("holds no rows")
        if (unknown := rows[0][1].keys() - {*outputs, *parameters, ""}) and not values.experiment.undeclared:
            raise ValueError(f"has columns {shown(sorted(unknown))}, which are neither parameters nor outputs")
        first: dict[Any, int] = {}  # the line of each number, by its column and its place
        for number, row in rows:
            with problems.at(where, f"{file}, line {number}: "):
                if "" in row or None in row.values():
                    raise ValueError(f"does not have {len(reader.fieldnames or ())} cells as the header has")
                place, said = list[Value](), list[str]()
                for column, cell in row.items():
                    if column in parameters and (column not in outputs or column in axes):
                        kind, is_none = parameters[column].kind, cell == "None" and parameters[column].reads_none
                        raw = None if is_none else cell if kind == "str" else read_cell(cell, kind)
                        value = compared(parameters[column], raw)
                        place.append(cell if kind == "any" else value)  # 1.10 may be a name
                    elif cell and isinstance(read_cell(cell, "float"), str):
                        raise ValueError(f"{column} = {shown(cell)}: must be a number or empty")
                    elif cell:
                        said.append(column)
                for column in said:
                    if (line := first.setdefault((column, *place), number)) != number:
                        raise ValueError(f"{column}: line {line} has a number for the same point")
        others = {n: raw for n, raw in about.where.items() if n not in form.fixed or form.fixed[n] != raw}
        along = {name: values.one(("published", "where", name), name, raw) for name, raw in others.items()}
        return Published(about, tuple(row for _, row in rows), {**fixed, **along})
    return None
