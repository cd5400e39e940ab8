"""Results of every kind as one thing: what a dataset is, its tables, and how it is saved and opened.

This is the one place that tells kinds of datasets apart.  Each kind names the module that makes its tables, which is
imported when they are first wanted, with three functions of the dataset:

- ``tables`` for reading, and ``notes``, the sentences below them;
- ``records``, the one table for programs.
"""

import json
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from linksweep.sweep.contract import SweepError
from linksweep.sweep.table_writer import Table

if TYPE_CHECKING:
    import xarray as xr

Kind = Literal["grid", "law", "crossings", "sensitivity", "scaling", "tie", "forecast"]
"""Results of a study; what is derived from them; measurements of `sweep scaling`; links and forecasts of tables."""

MODULES: Mapping[Kind, str] = {
    "grid": "linksweep.sweep.analysis.results_table",
    "law": "linksweep.sweep.analysis.derived",
    "crossings": "linksweep.sweep.analysis.derived",
    "sensitivity": "linksweep.sweep.analysis.derived",
    "scaling": "linksweep.sweep.analysis.derived",
    "tie": "linksweep.sweep.tie.result",
    "forecast": "linksweep.sweep.tie.result",
}

MARKS: Mapping[str, Kind] = {
    "law": "law",
    "condition": "crossings",
    "sensitivity_method": "sensitivity",
}
"""Attributes that only datasets of one kind have; a link and a forecast have the name of their kind as ``result``."""

STORED_TABLES: tuple[Kind, ...] = ("tie", "forecast")
"""Kinds whose stores are one dataset, without a study and its ledger."""


def kind_of(dataset: "xr.Dataset") -> Kind:
    """Return the kind of a dataset; raises SweepError for one that is no result of linksweep."""
    if (name := dataset.attrs.get("result")) in STORED_TABLES:
        return name  # type: ignore[no-any-return]
    for mark, kind in MARKS.items():
        if mark in dataset.attrs:
            return kind
    if "status" in dataset:
        return "grid"
    if {"seconds", "efficiency"} <= set(dataset.data_vars):
        return "scaling"
    raise SweepError("the dataset is no result of a study: it has no status")


@dataclass(frozen=True)
class Result:
    """A dataset of any kind, and what it can show."""

    dataset: "xr.Dataset"

    @property
    def kind(self) -> Kind:
        """What it is."""
        return kind_of(self.dataset)

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
        records = self.records()
        return {"csv": records.csv, "ecsv": records.ecsv, "json": records.json}[table_format]()

    def save(self, path: Path) -> None:
        """Write the dataset as a Zarr store in one step: a process that is killed leaves nothing at ``path``.

        Raises SweepError where something exists already, and where writing is not possible.
        """
        require_free(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as folder:
                with warnings.catch_warnings():  # text and consolidated metadata have no final specification in Zarr 3
                    warnings.simplefilter("ignore")
                    self.dataset.to_zarr(Path(folder) / "new", mode="w", zarr_format=3)
                (Path(folder) / "new").rename(path)
        except OSError as error:
            raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error

    def _made(self, what: str) -> Any:
        return getattr(import_module(MODULES[self.kind]), what)(self.dataset)


def require_free(path: Path) -> None:
    """Raise SweepError where something exists already."""
    if path.exists():
        raise SweepError("exists already; give another place with -o", str(path))


def open_result(where: Any) -> Result:
    """Return the results in a store of any kind, in memory.

    Raises SweepError if there is no store, if it has no results yet, or if it is damaged.
    """
    from linksweep.sweep.stores.store import open_dataset

    return stored_table(where) or Result(open_dataset(where))


def stored_table(where: Any) -> Result | None:
    """Return a stored link or forecast, loaded into memory; None for anything else, such as the store of a study.

    Raises SweepError for one that is damaged.
    """
    from linksweep.sweep.stores.location import Folder, reading

    folder = Path(str(where))
    try:
        attributes = json.loads(Folder(folder).get("zarr.json") or b"{}").get("attributes", {})
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    if not isinstance(attributes, dict) or attributes.get("result") not in STORED_TABLES:
        return None
    import xarray as xr

    with reading(Folder(folder)):
        Folder(folder).require_plain()
    try:
        with xr.open_zarr(folder) as stored:
            return Result(stored.load())
    except Exception as error:  # decoders of a damaged file may raise anything
        raise SweepError(f"is damaged: {' '.join(str(error).split())}", str(where)) from error
