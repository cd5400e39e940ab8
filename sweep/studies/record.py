"""What a store records of a study, so that it can be read without its code: its experiment, and where it comes from."""

import json
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

from linksweep.sweep.code import Code, SourceFunction, version_of
from linksweep.sweep.contract import Experiment, Named, Output, Parameter, Point, SweepError, Unknown, refused, shown
from linksweep.sweep.contract.experiment import setting_problem
from linksweep.sweep.formatting import command_line, host, now
from linksweep.sweep.functions.adapter import experiment_of_record, layout_of_record
from linksweep.sweep.studies.reader import study_of_attributes
from linksweep.sweep.studies.study import CONVENTION, PART, POINT_TABLE, Study
from linksweep.sweep.tables.columns import sorted_json

# The attribute of a store that holds the record, as JSON.
RECORD = "experiment_record"

PACKAGES = ("linksweep", "numpy", "scipy", "dask", "distributed", "xarray", "zarr")

# Attributes: what an experiment calls draws that realisations share, and what it asks to cite, as JSON.
OUTER_DRAW, CITATION = "outer_draw", "citation"

# The attribute of results of a plain function: its name.
FUNCTION = "function"

# The axes on which the cost of a point depends, and the cost by their values.
Costs = tuple[tuple[str, ...], Mapping[tuple[Any, ...], float]]

_SAME = ("name", "version", "sums", "coordinates", "component_units", "shared", "nan_sums")


class Recorded(Code):
    """The code of a study that a store holds, to be looked at: its recorded experiment, and no way to load any."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__()
        self.recorded = experiment

    def experiment(self, reference: str, folder: Path) -> Experiment:
        """Return the recorded experiment, whatever is named."""
        return self.recorded

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Raise SweepError: looking at a store never runs what it names."""
        raise SweepError(f"names {shown(reference)}, and looking at a store never runs what it names")


def recorded(study: Study, costs: Costs | None) -> str:
    """Return the record of a study's experiment: all that it declares, and the costs of the study's points if known."""
    experiment = study.experiment
    record = {name: getattr(experiment, name) for name in _SAME}
    for name in ("parameters", "outputs", "sample_outputs"):
        record[name] = [
            {f.name: v for f in fields(one) if (v := getattr(one, f.name)) != f.default and not callable(v)}
            for one in getattr(experiment, name)
        ]
    if further := experiment.as_record():
        record |= {"coordinates": {}} | further
    if costs is not None:
        record |= {"cost_axes": costs[0], "costs": {sorted_json(list(key)): cost for key, cost in costs[1].items()}}
    return json.dumps(record, default=_jsonable)


def _jsonable(value: Any) -> Any:
    if isinstance(value, Named):
        return [value.name, value.identity]
    plain = dict if isinstance(value, Mapping) else str  # dates and others as texts
    return value.item() if hasattr(value, "item") else plain(value)  # numbers of NumPy


def as_written(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return sections of a study as the document of a store has them."""
    written: dict[str, Any] = json.loads(json.dumps(sections, default=_jsonable))
    return written


def recorded_study(attributes: Mapping[str, Any], where: str, *, whole: bool = False) -> Study:
    """Return the study of a store, with an experiment that is made from the store's record and computes nothing; the
    ``whole`` document says what another store needs to make the study again.

    Raises SweepError if the record, or a table that the study names, is missing or does not fit.
    """
    if RECORD not in attributes:
        raise SweepError("has no record of its experiment", where)
    errors = LookupError, TypeError, ValueError, AttributeError, ArithmeticError, MemoryError, RecursionError
    with refused(*errors, said="the record of its experiment cannot be read: ", where=where):
        code = Recorded(_experiment(json.loads(attributes[RECORD])))
        written = json.loads(attributes["study_document"])
        # what would load code, or be wrong where outputs are not known; results have attributes of their own for it
        left_out = {"define"} if whole else {"define", "published", "claim", "conclusion", "figure"}
        document = {key: section for key, section in written.items() if key not in left_out}
        study = study_of_attributes({**attributes, "study_document": json.dumps(document)}, where, code)
        return replace(study, sections={**study.sections, **{key: written[key] for key in left_out & written.keys()}})


def as_recorded(study: Study, attributes: Mapping[str, Any]) -> Study:
    """Return a study; if it is of a plain function, with the layout of results that the store has recorded, if any."""
    layout = layout_of_record(json.loads(attributes.get(RECORD, "{}")))
    return replace(study, experiment=study.experiment.with_layout(layout))


def _experiment(record: Mapping[str, Any]) -> Experiment:
    parameters = tuple(_made(Parameter, parameter) for parameter in record["parameters"])
    if "function" in record:
        return experiment_of_record(record, parameters)

    def nothing(*_arguments: Any, **_named: Any) -> Any:
        raise SweepError("the record of an experiment computes nothing")

    names, costs = record.get("cost_axes", ()), {key: float(one) for key, one in record.get("costs", {}).items()}
    if unknown := {*names} - {parameter.name for parameter in parameters}:
        raise ValueError(f"costs by {shown(min(unknown))}, which is no parameter")

    def cost(point: Point) -> float:
        key = sorted_json([point[name] for name in names])
        return costs[key] if key in costs else nothing()

    outputs, samples = (tuple(_made(Output, o) for o in record[key]) for key in ("outputs", "sample_outputs"))
    more: dict[str, Any] = {} if costs == {sorted_json([]): 1.0} else {"cost": cost}  # by default all cost the same
    return Experiment(
        **{key: _tuples(record[key]) for key in _SAME},
        parameters=parameters,
        outputs=outputs,
        evaluate=nothing,
        summarise=nothing,
        samples=nothing if samples else None,
        sample_outputs=samples,
        **more,
    )


def _made(kind: Any, stored: Mapping[str, Any]) -> Any:
    known = {field.name for field in fields(kind)}
    values = {name: _tuples(value) for name, value in stored.items() if name in known}
    if "defined" in values:
        values["defined"] = tuple(Named(name, identity, Unknown) for name, identity in values["defined"])
    if values.get("kind", "any") in ("any", "object", "float") and isinstance(values.get("default"), tuple):
        values["default"] = Named(values["default"][0], values["default"][1], Unknown)
    made = kind(**({"default": None} if kind is Parameter else {}) | values)
    if problem := setting_problem(made):
        raise ValueError(problem)
    return made


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(one) for name, one in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def provenance(study: Study) -> dict[str, Any]:
    """Return the attributes of a result that say what it is of; plain strings and numbers."""
    experiment, sampling, points = study.experiment, study.sampling, study.points
    common = sampling.common_random_numbers
    about = [claim.model_dump(exclude_none=True, exclude_defaults=True) for claim in study.claims]
    conclusion = study.conclusion
    attributes: dict[str, Any] = {
        "title": study.title,
        "question": study.question or None,
        "description": study.description or None,
        "study_name": study.name,
        "study": study.text,
        "study_overrides": " ".join(study.overrides),
        "study_digest": study.digest(),
        "experiment": study.experiment_reference,
        FUNCTION: experiment.name if experiment.as_record() else None,
        "seed": None if experiment.deterministic else sampling.seed,
        **study.numbers(),
        "precision": sampling.precision,
        "error_convention": CONVENTION,
        POINT_TABLE: json.dumps({"parameters": list(points.names), **points.origin}) if points else None,
        "common_random_numbers": 1 if common else None,
        "shared_axes": json.dumps([axis for axis in study.axes if axis in experiment.shared]) if common else None,
        OUTER_DRAW: experiment.outer_draw if experiment.outer_draw not in ("", "outer draw") else None,
        CITATION: json.dumps(experiment.citation) if experiment.citation else None,
        "study_document": json.dumps(study.document, default=_jsonable),
        "started": now(),
        "published_digest": study.published.digest if study.published else None,
        "claims": json.dumps(about) if about else None,
        "conclusion": conclusion.model_dump_json(exclude_none=True, exclude_defaults=True) if conclusion else None,
        PART: None if study.part is None else str(study.part),
    }
    return {name: value for name, value in attributes.items() if value is not None}


def outer_draw_of(attributes: Mapping[Any, Any]) -> str:
    """Return what results with these attributes call draws that several realisations share."""
    return str(attributes.get(OUTER_DRAW, "outer draw" if "experiment" in attributes else "catalogue"))


_GIT = Lock()  # several threads may run studies


def begun_by() -> dict[str, str]:
    """Return the attributes of a result that say by what it is made: this process, its command and its packages."""
    with _GIT:
        _asked_git()  # which takes as long to answer as a short run to compute
    attributes = {
        "versions": json.dumps({"python": platform.python_version()} | {p: version_of(p) for p in PACKAGES}),
        "host": host(),
        "machine": f"{platform.system()} {platform.machine()}",
        "command": command_line(),
    }
    return {name: value for name, value in attributes.items() if value}


def made_by() -> dict[str, str]:
    """Return those of one that is written now: the commit, too, and the time."""
    begun = begun_by()
    with _GIT:
        commit = git_commit()
    return begun | ({"git_commit": commit} if commit else {}) | {"finished": now()}


@cache  # this process computes with the code that it has imported
def _asked_git() -> "subprocess.Popen[str] | None":
    """Start git in the checkout this package runs from, to say its commit; None outside one, and without git."""
    folder = Path(__file__).resolve().parents[2]
    # without optional locks: an interruption may kill git, which would leave its lock in the checkout
    command = ["git", "--no-optional-locks", "-C", str(folder), "describe", "--always", "--exclude=*", "--abbrev=40"]
    command.append("--dirty=+changes")
    with suppress(OSError):
        if (folder / ".git").exists():
            return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return None


@cache
def git_commit() -> str:
    """Return the commit of the checkout, with '+changes' if it was edited; '' where git does not say it."""
    if (process := _asked_git()) is None:
        return ""
    try:
        return process.communicate(timeout=5)[0].strip()
    except subprocess.TimeoutExpired:
        process.kill()
        return ""
