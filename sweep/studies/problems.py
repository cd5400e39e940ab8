"""The problems of one study, gathered so that all are told at once, each with its key and its line."""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

from sweep.contract import SweepError, shown
from sweep.studies.source import Place, line_of, lines_of_keys

MAX_PROBLEMS = 50
"""After so many problems of one study the rest is not looked for."""


class Problems:
    """Takes problems of a study by their place in its document.

    ``overridden`` says which options of the command line gave a value.
    """

    def __init__(self, text: str, path: Path, found: list[str], overridden: Mapping[Place, str]) -> None:
        self.found = found
        self._text, self._path, self._overridden = text, path, overridden

    @cached_property
    def _lines(self) -> dict[Place, int]:
        return lines_of_keys(self._text)

    def add(self, where: Place, message: str) -> None:
        """Take one problem; raises SweepError where there are too many."""
        if len(self.found) >= MAX_PROBLEMS:
            raise SweepError([*self.found, "... and perhaps more problems like these"], str(self._path))
        source = self._overridden.get(where[:2]) or self._overridden.get(where[:1])
        if source is None:
            line = line_of(self._lines, where)
            source = f"line {line}" if line else None
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in where)
        self.found.append(f"{key}{f' ({source})' if source else ''}: {message}")

    def raise_if_any(self) -> None:
        """Raise SweepError with all problems."""
        if self.found:
            raise SweepError(self.found, str(self._path))
