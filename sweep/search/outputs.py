"""The files of a search: checked before it, each written in one step after it."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError
from linksweep.sweep.search.columns import TYC
from linksweep.sweep.search.ecsv import matches_table
from linksweep.sweep.search.galaxy_table import GalaxyTable, format_galaxy_table
from linksweep.sweep.search.options import Search
from linksweep.sweep.search.result import Result, match_columns
from linksweep.sweep.search.tables import SkyTable

MAP_SUFFIXES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Outputs:
    """The files to write; None for those that are not wanted."""

    ecsv: Path | None = None
    table: Path | None = None
    sky_map: Path | None = None

    def paths(self) -> list[Path]:
        """Return the paths of the files that are wanted."""
        return [path for path in (self.ecsv, self.table, self.sky_map) if path is not None]


def check_outputs(outputs: Outputs, search: Search, overwrite: bool) -> None:
    """Raise SweepError if an output cannot or must not be written: better before a long search than after it."""
    problems: list[str] = []
    inputs = {path.resolve() for path in (search.stars, search.supplement, *search.galaxies) if path is not None}
    wanted = [path.resolve() for path in outputs.paths()]
    for path in outputs.paths():
        parent = next(p for p in path.absolute().parents if p.exists())
        if path.resolve() in inputs:
            problems.append(f"{path} is one of the tables that are read")
        elif wanted.count(path.resolve()) > 1:
            problems.append(f"{path} is named for two outputs")
        elif path.is_dir():
            problems.append(f"{path} is a directory")
        elif path.exists() and not overwrite:
            problems.append(f"{path} exists; --overwrite replaces it")
        elif not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            problems.append(f"{path} cannot be written: {parent} is not a directory that can be written")
    for output, suffixes in ((outputs.ecsv, (".ecsv",)), (outputs.sky_map, MAP_SUFFIXES)):
        if output is not None and output.suffix.lower() not in suffixes:
            problems.append(f"{output} must end in {' or '.join(suffixes)}")
    if outputs.sky_map is not None and find_spec("matplotlib") is None:
        problems.append("a map needs matplotlib: install linksweep[plot]")
    if problems:
        raise SweepError(list(dict.fromkeys(problems)))


def check_for_galaxy_table(stars: Sequence[SkyTable]) -> None:
    """Raise SweepError unless all star tables have Tycho identifiers."""
    problems = [
        f"{table.path}: the 46-byte table needs columns TYC1, TYC2 and TYC3, or TYC with strings like '1-13-1'"
        for table in stars
        if table.tyc is None
    ]
    if problems:
        raise SweepError(problems)


def write_outputs(result: Result, outputs: Outputs, overwrite: bool = False) -> None:
    """Write the matches as ECSV, as 46-byte table and as map, each in one step; nothing if one cannot be made.

    Raises SweepError as `check_outputs` and `format_galaxy_table`.
    """
    check_outputs(outputs, result.search, overwrite)
    writers: list[tuple[Path, Callable[[Path], Any]]] = []
    if outputs.table is not None:
        text = format_galaxy_table(galaxy_table(result))
        writers.append((outputs.table, lambda path: path.write_bytes(text.encode("ascii"))))
    if outputs.ecsv is not None:
        table = matches_table(result)
        writers.append((outputs.ecsv, lambda path: table.write(path, format="ascii.ecsv")))
    if outputs.sky_map is not None:
        from linksweep.sweep.search.skymap import sky_map_of

        figure, kind = sky_map_of(result), outputs.sky_map.suffix[1:].lower()
        writers.append((outputs.sky_map, lambda path: figure.savefig(path, format=kind, dpi=200)))
    for path, write in writers:
        publish(path, write, overwrite)


def galaxy_table(result: Result) -> GalaxyTable:
    """Return the matches as the paper's table, for stars that `check_for_galaxy_table` accepts."""
    columns = match_columns(result)
    tyc = np.stack([columns[name] for name in TYC], axis=1)
    return GalaxyTable(tyc, columns["PGC"], columns["ra"], columns["dec"], result.matches.code)


def publish(path: Path, write: Callable[[Path], Any], overwrite: bool) -> None:
    """Write a file under a temporary name, and rename it when it is complete."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(part)
        if overwrite:
            part.replace(path)
        else:
            _rename_new(part, path)
    except FileExistsError as error:
        raise SweepError("exists; --overwrite replaces it", str(path)) from error
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    finally:
        part.unlink(missing_ok=True)


def _rename_new(part: Path, path: Path) -> None:
    """Rename a file unless its new name is taken."""
    try:
        os.link(part, path)  # unlike a rename, this fails if the file exists by now
    except OSError as error:  # the name is taken, or the file system has no hard links
        if isinstance(error, FileExistsError) or path.exists():
            raise FileExistsError(path) from error
        part.rename(path)
