"""Results of every kind as one thing: what a dataset is, its tables, and how it is saved and opened.

This is the one place that tells kinds of datasets apart.  A kind has a module that makes its tables, which is imported
when they are first wanted, with functions of the dataset: ``headline``, what it says in sentences, ``tables`` for
reading, ``notes``, the sentences below them, and ``records``, the one table for programs.
"""

import json
import os
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from linksweep.sweep.contract import SweepError, refused
from linksweep.sweep.stores.integrity import Tables, checked
from linksweep.sweep.stores.location import Folder, reading
from linksweep.sweep.table_writer import Table

if TYPE_CHECKING:
    import xarray as xr

# results of a study; what is derived from them; measurements of `sweep scaling`; links, forecasts and matches of tables
ResultKind = Literal["grid", "law", "crossings", "sensitivity", "scaling", "tie", "forecast", "match"]

# What these are is the attribute ``result``; their stores are one dataset, without a study and its ledger.
STORED_TABLES: tuple[ResultKind, ...] = ("tie", "forecast", "match", "law", "crossings", "sensitivity", "scaling")


@dataclass(frozen=True)
class Result:
    """A dataset of any kind, and what it can show."""

    dataset: "xr.Dataset"

    @property
    def kind(self) -> ResultKind:
        """What it is; raises SweepError for a dataset that is no result of linksweep."""
        if (name := self.dataset.attrs.get("result")) in STORED_TABLES:
            return name  # type: ignore[no-any-return]
        if "status" not in self.dataset:
            raise SweepError("the dataset is no result of a study: it has no status")
        return "grid"

    @property
    def title(self) -> str:
        """Its title: that of the study, or of a link or a forecast the names of its tables."""
        about = self.dataset.attrs
        if "satellite" not in about:
            return str(about.get("title", ""))
        what = "Forecast of the link" if self.kind == "forecast" else "Link"
        return f"{what} of {Path(str(about['satellite'])).name} and {Path(str(about['reference'])).name}"

    @property
    def subtitle(self) -> str:
        """How it was made, where figures say that below the title."""
        about = self.dataset.attrs
        if "sign" in about:
            return f"{about['sign'].replace('-', ' − ')}, epoch {about['epoch']:.2f}, clip {about['clip']}"
        if "sensitivity_method" in about:
            return f"sensitivity of {about['output']}, by {about['sensitivity_method']}"
        return ""

    def headline(self) -> list[str]:
        """Return what it says in sentences; not of the grid of a study, of which the answer says that."""
        return list(self._made("headline"))

    def tables(self) -> list[Table]:
        """Return its tables for reading."""
        return list(self._made("tables"))

    def notes(self) -> list[str]:
        """Return the sentences below its tables."""
        return list(self._made("notes"))

    def records(self) -> Table:
        """Return its table for programs."""
        made: Table = self._made("records")
        return made

    def written(self, table_format: str) -> str:
        """Return its table for programs as "csv", "ecsv" or "json", or its tables and notes as "text"."""
        if table_format == "text":
            return "\n\n".join([*(table.text() for table in self.tables()), "\n".join(self.notes())]).rstrip()
        written: str = getattr(self.records(), table_format)()
        return written

    def save(self, path: Path) -> None:
        """Write the dataset as a Zarr store in one step: a process that is killed leaves nothing at ``path``.

        Raises SweepError where something exists already, and where writing is not possible.
        """
        require_free(path)
        # it warns that text and consolidated metadata have no final specification in Zarr 3
        write_at_once(path, lambda new: self.dataset.to_zarr(new, mode="w", zarr_format=3))

    def _made(self, what: str) -> Any:
        modules = {"tie": "tie.result", "forecast": "tie.result", "match": "search.search"}
        module = modules.get(self.kind, "analysis.tables")
        return getattr(import_module(f"linksweep.sweep.{module}"), what)(self.dataset)


def write_at_once(path: Path, write: Callable[[Path], Any]) -> None:
    """Let a function write another path, without its warnings, and give this its name; raises SweepError if it cannot.

    The name is the same in another folder, because the format may depend on it.
    """
    with reading(path, "cannot be written"):
        real = Path(os.path.realpath(path))  # a link stays one
        real.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=real.parent, prefix=".linksweep-") as folder:
            with warnings.catch_warnings(action="ignore"):
                write(Path(folder) / path.name)
            (Path(folder) / path.name).replace(real)


def require_free(path: Path) -> None:
    """Raise SweepError where something exists already."""
    if path.exists():
        raise SweepError("exists already; give another place with -o", str(path))


def open_result(where: Any, running: bool = False) -> Result:
    """Return the results in a store of any kind, in memory; those of a study with values so far if ``running``.

    Raises SweepError if there is no store, if it has no results yet, or if it is damaged.
    """
    from linksweep.sweep.analysis.quantity import with_running
    from linksweep.sweep.stores.store import OpenStore

    return stored_table(where) or Result(with_running(OpenStore(where).dataset(running)))


def stored_table(where: Any) -> Result | None:
    """Return a store that is one dataset, loaded into memory; None for anything else, such as the store of a study.

    Raises SweepError for one that is damaged.
    """
    folder = Path(str(where))
    try:
        root = json.loads(Folder(folder).get("zarr.json") or b"{}")
        attributes = root.get("attributes", {})
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    if not isinstance(attributes, dict) or attributes.get("result") not in STORED_TABLES:
        return None
    import xarray as xr

    with reading(Folder(folder)):
        Folder(folder).require_plain()
    with refused(Exception, said="is damaged: ", where=where):  # decoders of a damaged file may raise anything
        checked(Tables, root)
        with xr.open_zarr(folder, consolidated=True) as stored:
            return Result(stored.load())
