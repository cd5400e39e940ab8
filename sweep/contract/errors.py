"""Errors that are shown to a user as sentences, and how they show values and guess at misspelt words."""

import difflib
import reprlib
from collections.abc import Sequence
from typing import Any

from linksweep.sweep.formatting import harmless

# The most names that a message lists.
FEW = 20


class SweepError(Exception):
    """Bad input, or a state that the user must know about.

    Args:
        problems: a sentence for each problem.
        where: the file or command that they are about.
    """

    exit_code = 2
    """With which a command ends."""

    def __init__(self, problems: str | Sequence[str], where: str = "") -> None:
        self.problems = [harmless(text) for text in ([problems] if isinstance(problems, str) else problems)]
        self.where = where
        super().__init__("\n".join(self.problems))

    def __str__(self) -> str:
        """Return a line for each problem, behind the file or command that it is about."""
        where = f"{harmless(self.where)}: " if self.where else ""
        return "\n".join(f"{where}{problem}" for problem in self.problems)

    def _render_traceback_(self) -> list[str]:
        """Return what IPython shows in place of a traceback, which would be that of linksweep."""
        return [f"{type(self).__name__}: {self}"]


class _Short(reprlib.Repr):
    """A repr of bounded length and depth, also of integers so large that Python refuses to print them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxstring = self.maxother = 60

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() <= 1100 else f"an integer of {x.bit_length()} bits"

    def repr_Named(self, x: Any, level: int) -> str:  # noqa: N802 (the name is reprlib's)
        return self.repr_str(x.name, level)


def shown(value: object) -> str:
    """Return a value as messages show it: its repr, cut short where it is long or deep."""
    return _Short().repr(value)


class DefinitionError(ValueError):
    """A wrong definition of a value; ``problems`` holds pairs (key, sentence), with an empty key for the whole."""

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(f"{key}: {sentence}" if key else sentence for key, sentence in problems))


def nearest(word: str, known: Sequence[str]) -> str:
    """Return '; did you mean ...?' for a misspelt word; '' where none of the known words is like it."""
    near = [one for one in known if len(word) > 2 and one.startswith(f"{word}_")]  # the mean of what was returned
    near += difflib.get_close_matches(word, known, n=1, cutoff=0.65)
    # One that is in the other: `heatmap` is no map, and `decay` may be decay.zarr.
    near += sorted(
        (one for one in known if word and min(len(word), len(one)) > 2 and (one in word or word in one)), key=len
    )
    return f"; did you mean {near[0]!r}?" if near else ""


def suggest(word: str, known: Sequence[str]) -> str:
    """Return what `nearest` does, or else the list of known words if it is short."""
    return nearest(word, known) or (f"; known are {', '.join(sorted(known))}" if len(known) <= FEW else "")
