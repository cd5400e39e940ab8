"""Which code a store may run: none when it is looked at, and when it is computed from, what the user allows.

Looking at a store loads nothing that it names: see `sweep.studies.record.Recorded`.  Computing from it does.  Where
that code lies inside the store, or the store was not written here, the user must allow it with ``--trust``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from linksweep.sweep.code.load import Code, file_of
from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.stores.integrity import ROOT
from linksweep.sweep.stores.location import Folder, Location
from linksweep.sweep.stores.store import was_written_here
from linksweep.sweep.studies.study import DEFAULT_EXPERIMENT


def asking(location: Location, attributes: Mapping[str, Any], trust: bool = False) -> Code:
    """Return what loads the code that a store names, where the user has allowed it (``trust``), or need not be asked;
    elsewhere it raises SweepError that names the code.
    """

    def check(reference: str) -> None:
        if trust or reference == DEFAULT_EXPERIMENT:
            return
        file = file_of(reference)
        inside = isinstance(location, Folder) and Path(file).resolve().is_relative_to(location.path.resolve())
        if not inside and was_written_here(location, attributes):
            return
        here = "the store was not written here: by this user, on this host, at this place"
        reason = "which lies inside the store" if inside else f"and {here}"
        sentence = f"would run {file}, {reason}; inspect it, and give --trust if it may run"
        raise SweepError(sentence, str(location))

    return Code(check)


def ours_alone() -> Code:
    """Return what loads the link, for a store of it that is looked at, and raises SweepError for anything else."""

    def check(reference: str) -> None:
        if reference != DEFAULT_EXPERIMENT:
            raise SweepError(
                f"only stores of the link alone can be drawn so; this one names {shown(reference)}, and looking at a "
                "store never runs what it names"
            )

    return Code(check)


def require_trust_of_study(path: Path, trust: bool) -> None:
    """Raise SweepError for a study file that lies inside a store: what it names came with the store."""
    store = next((folder for folder in path.resolve().parents if (folder / ROOT).is_file()), None)
    if store is not None and not trust:
        raise SweepError(
            f"lies inside the store {store}, and would run what it names; inspect it, and give --trust if it may run",
            str(path),
        )
