"""What a study is: a validated record of axes, fixed parameters and sampling."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from sweep.contract import Experiment, Value
from sweep.tablefile import content_digest

Seed = Annotated[int, Field(ge=0, lt=2**64)]
Count = Annotated[int, Field(ge=1, le=10**9)]


class Section(BaseModel):
    """A table of the study file: unknown keys and values of another type are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Sampling(Section):
    """How many realisations: ``n_sim`` for each of ``n_cat`` catalogues, from one ``seed``."""

    n_sim: Count = 1000
    n_cat: Count = 1
    seed: Seed = 0
    keep_samples: bool = False


@dataclass(frozen=True)
class Condition:
    """One clause of an exclusion: the parameter's value is in ``among``, or above and below the bounds that are
    given.
    """

    name: str
    among: tuple[Value, ...] | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, value: Any) -> bool:
        """Return whether a parameter's value meets the condition."""
        if self.among is not None:
            return value in self.among
        return (self.above is None or value > self.above) and (self.below is None or value < self.below)


@dataclass(frozen=True)
class Published:
    """Published results: rows of {column: number as printed}, the columns being axes and outputs."""

    source: str
    rows: tuple[Mapping[str, str], ...]


@dataclass(frozen=True)
class Study:
    """A validated study.  ``axes`` maps a parameter to its values; ``fixed`` holds the other parameters that it
    sets.
    """

    name: str
    title: str
    experiment_reference: str
    experiment: Experiment = field(repr=False)
    axes: Mapping[str, tuple[Value, ...]]
    fixed: Mapping[str, Value]
    sampling: Sampling
    zipped: tuple[tuple[str, ...], ...] = ()
    excluded: tuple[tuple[Condition, ...], ...] = ()
    published: Published | None = None
    source: str = ""
    text: str = ""
    overrides: tuple[str, ...] = ()

    def meaning(self) -> dict[str, Any]:
        """Return what the numbers of any point mean beside its own parameters: if this differs, results cannot be
        mixed.
        """
        defaults = self.experiment.defaults()
        return {
            "experiment": self.experiment.name,
            "experiment_version": self.experiment.version,
            "seed": self.sampling.seed,
            **({"keep_samples": True} if self.sampling.keep_samples else {}),
            "fixed": {k: v for k, v in sorted(self.fixed.items()) if v != defaults[k]},
        }

    def digest(self) -> str:
        """Return a SHA-256 of everything that decides the results, whatever the layout of the file."""
        whole = self.meaning() | {
            "axes": self.axes,
            "n_sim": self.sampling.n_sim,
            "n_cat": self.sampling.n_cat,
            "zip": self.zipped,
            "exclude": [[vars(c) for c in clause] for clause in self.excluded],
        }
        return hashlib.sha256(json.dumps(whole, sort_keys=True, default=content_digest).encode()).hexdigest()
