"""The problems of one study, collected so that all are reported at once, each with its key and its line."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from functools import cache

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.studies.source import Place, lines_of_keys

MAX_PROBLEMS = 50
"""After this many problems of one study no more are looked for."""


class Problems:
    """Takes problems of a study by their place in its document.

    ``where`` names the study, ``text`` is the text of its file, ``found`` are problems so far, and ``overridden`` says
    which option of the command line gave the value at a place.
    """

    def __init__(
        self, where: str, text: str = "", found: Sequence[str] = (), overridden: Mapping[Place, str] | None = None
    ) -> None:
        self.found, self.overridden = list(found), overridden or {}
        self._where = where
        self._lines = cache(lambda: lines_of_keys(text))
        self._table: Place = ()

    def inside(self, *table: str | int) -> "Problems":
        """Return an object that takes problems for the same list by their place in one table of the document."""
        inner = copy(self)
        inner._table = (*self._table, *table)
        return inner

    def add(self, place: Place, message: str) -> None:
        """Take one problem; raises SweepError where there are too many."""
        if len(self.found) >= MAX_PROBLEMS:
            raise SweepError([*self.found, "... and perhaps more problems like these"], self._where)
        whole = (*self._table, *place)
        around = [whole[:n] for n in range(len(whole), 0, -1)]  # the value, and the tables that it is in
        source = next((self.overridden[table] for table in around if self.overridden.get(table)), None)
        if source is None:
            source = next((f"line {self._lines()[table]}" for table in around if table in self._lines()), None)
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in whole)
        self.found.append(f"{key}{f' ({source})' if source else ''}: {message}")

    @contextmanager
    def at(self, place: Place, before: str = "") -> Iterator[None]:
        """Take the message of a ValueError or SweepError as problems of a place, with the text ``before`` it."""
        try:
            yield
        except ValueError as error:
            self.add(place, f"{before}{error}")
        except SweepError as error:
            for problem in error.problems:
                self.add(place, f"{before}{problem}")
