"""Where results come from: versions, machine, git commit, times."""

import json
import platform
import shlex
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from linksweep.sweep.code.reach import version_of
from linksweep.sweep.formatting import COMMAND, without_secrets
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.studies.study import POINT_TABLE, Study
from linksweep.sweep.tables.file import content_digest

PACKAGES = ("linksweep", "numpy", "scipy", "dask", "distributed", "xarray", "zarr")

ERROR_CONVENTION = 2
"""How the errors in a dataset were computed (docs/errors.md): 2 means that catalogues are the independent samples;
datasets from before that have no such attribute.
"""

OUTER_DRAW, CITATION = "outer_draw", "citation"
"""Attributes: what an experiment calls draws that realisations share, and what it asks to cite, as JSON."""

OF_THE_LINK = ("linksweep.core.", "linksweep.sweep.tie.")
"""Modules of experiments that come with linksweep and share catalogues."""

FUNCTION = "function"
"""The attribute of results of a plain function: its name."""


def provenance(study: Study) -> dict[str, Any]:
    """Return the attributes of a result that say how it was made; plain strings and numbers."""
    experiment, sampling, points = study.experiment, study.sampling, study.points
    common = sampling.common_random_numbers
    own_words = not is_of_the_link({"experiment": study.experiment_reference})
    defined = {
        parameter.name: {named.name: content_digest(named) for named in parameter.defined}
        for parameter in experiment.parameters
        if parameter.defined
    }
    claims = [claim.model_dump(exclude_none=True, exclude_defaults=True) for claim in study.claims]
    conclusion = study.conclusion
    attributes: dict[str, Any] = {
        "title": study.title,
        "question": study.question or None,
        "study_name": study.name,
        "study": study.text,
        "study_overrides": " ".join(study.overrides),
        "study_digest": study.digest(),
        "experiment": study.experiment_reference,
        FUNCTION: experiment.name if isinstance(experiment, FunctionExperiment) else None,
        "seed": None if experiment.deterministic else sampling.seed,
        **study.numbers(),
        "precision": sampling.precision,
        "error_convention": ERROR_CONVENTION,
        POINT_TABLE: json.dumps({"parameters": list(points.names), **points.origin}) if points else None,
        "common_random_numbers": 1 if common else None,
        "shared_axes": json.dumps([axis for axis in study.axes if axis in experiment.shared]) if common else None,
        OUTER_DRAW: experiment.outer_draw if own_words and experiment.outer_draw not in ("", "outer draw") else None,
        CITATION: json.dumps(experiment.citation) if own_words and experiment.citation else None,
        "study_document": json.dumps(study.document),
        "versions": json.dumps({"python": platform.python_version()} | {p: version_of(p) for p in PACKAGES}),
        "host": host(),
        "machine": f"{platform.system()} {platform.machine()}",
        "command": command_line() or None,
        "started": now(),
        "defined": json.dumps(defined) if defined else None,
        "claims": json.dumps(claims) if claims else None,
        "conclusion": conclusion.model_dump_json(exclude_none=True, exclude_defaults=True) if conclusion else None,
        "git_commit": git_commit(),
    }
    return {name: value for name, value in attributes.items() if value is not None}


def is_of_the_link(attributes: Mapping[Any, Any]) -> bool:
    """Return whether results with these attributes are of an experiment that comes with linksweep."""
    return str(attributes.get("experiment", OF_THE_LINK[0])).startswith(OF_THE_LINK)


def outer_draw_of(attributes: Mapping[Any, Any]) -> str:
    """Return what results with these attributes call draws that several realisations share."""
    return str(attributes.get(OUTER_DRAW, "catalogue" if is_of_the_link(attributes) else "outer draw"))


def host() -> str:
    """Return the name of this machine."""
    return platform.node()


def command_line() -> str:
    """Return the `sweep` command that this process runs, as a person would type it but for secrets; '' in a script."""
    return without_secrets(shlex.join(COMMAND))


def now() -> str:
    """Return the time as ISO 8601 in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@cache  # this process computes with the code that it has imported
def git_commit() -> str | None:
    """Return the commit of the checkout this package runs from, with '+changes' if it was edited; None outside a
    checkout, without starting git.
    """
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        # without optional locks: an interruption may kill git, which would leave its lock in the checkout
        command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
