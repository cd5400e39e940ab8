"""Which code a store may run: none when it is looked at, and when it is computed from, what the user allows.

Looking at a store loads nothing that it names: see `sweep.studies.record.Recorded`.  Computing from it does.  Where
that code lies inside the store, or the store was not written here, the user must allow it with ``--trust``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from linksweep.sweep.code.load import Imports, SourceFunction, file_of
from linksweep.sweep.contract import Experiment, SweepError, shown
from linksweep.sweep.stores.folder import Folder
from linksweep.sweep.stores.location import Location
from linksweep.sweep.stores.origin import was_written_here
from linksweep.sweep.stores.root import ROOT

OURS = frozenset({"linksweep.core.experiment:link"})
"""Experiments that come with linksweep and may be named by any store."""


@dataclass(frozen=True)
class Asking:
    """Loads the code that a store names, where the user has allowed it (``trust``), or need not be asked."""

    location: Location
    attributes: Mapping[str, Any]
    trust: bool = False

    def experiment(self, reference: str, folder: Path) -> Experiment:
        """Return an experiment; raises SweepError that names the code if the user must be asked."""
        self._require_trust(reference)
        return Imports().experiment(reference, folder)

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Return a function; raises as `experiment`."""
        self._require_trust(reference)
        return Imports().function(reference, folder)

    def _require_trust(self, reference: str) -> None:
        file = file_of(reference)
        if self.trust or reference in OURS:
            return
        inside = isinstance(self.location, Folder) and Path(file).resolve().is_relative_to(self.location.path.resolve())
        if not inside and was_written_here(self.location, self.attributes):
            return
        here = "the store was not written here: by this user, on this host, at this place"
        reason = "which lies inside the store" if inside else f"and {here}"
        sentence = f"would run {file}, {reason}; inspect it, and give --trust if it may run"
        raise SweepError(sentence, str(self.location))


class OursAlone:
    """Loads the link, for a store of it that is looked at, and nothing else."""

    def experiment(self, reference: str, folder: Path) -> Experiment:
        """Return the link; raises SweepError for any other experiment."""
        if reference not in OURS:
            self._refuse(reference)
        return Imports().experiment(reference, folder)

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Raise SweepError."""
        self._refuse(reference)

    def _refuse(self, reference: str) -> NoReturn:
        raise SweepError(
            f"only stores of the link alone can be drawn so; this one names {shown(reference)}, and looking at a store "
            "never runs what it names"
        )


def require_trust_of_study(path: Path, trust: bool) -> None:
    """Raise SweepError for a study file that lies inside a store: what it names came with the store."""
    store = next((folder for folder in path.resolve().parents if (folder / ROOT).is_file()), None)
    if store is not None and not trust:
        raise SweepError(
            f"lies inside the store {store}, and would run what it names; inspect it, and give --trust if it may run",
            str(path),
        )
