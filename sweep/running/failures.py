"""Points that fail: how many of a run, why in words, and when a run that only fails ends."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.executing.task import Failure
from linksweep.sweep.formatting import counted, harmless
from linksweep.sweep.planning.grid import Grid, GridPoint, describe
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.stores.ledger import Record
from linksweep.sweep.studies.study import Study

# Most reasons of failed points that are named.
NAMED = 5

# Characters of a reason in a line.
LONGEST_REASON = 200

# A run ends where so many first points all fail for the same reason; a percentage is that of at least so many.
FIRST = 20

NUMBER = re.compile(r"0x[0-9a-f]+|[-+]?(?:\d[\d_,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)


class TooManyFailuresError(SweepError):
    """A run was ended because too many of its points failed; what was done is in the store."""

    exit_code = 1


@dataclass(frozen=True)
class MaxFailures:
    """The most points of a run that may fail before it is ended: a ``number``, or ``percent`` of those that were tried.

    >>> MaxFailures.parsed("5 %"), MaxFailures.parsed(3)
    (MaxFailures(number=None, percent=5.0), MaxFailures(number=3, percent=None))
    """

    number: int | None = None
    percent: float | None = None

    @classmethod
    def parsed(cls, text: "int | str") -> "MaxFailures":
        """Return the limit that a user gives; raises ValueError for anything else."""
        match = re.fullmatch(r"\s*(\d{1,15})\s*|\s*(\d{1,3}(?:\.\d*)?)\s*%\s*", str(text))
        if isinstance(text, bool) or match is None or (match[2] and float(match[2]) > 100.0):
            raise ValueError(f"{shown(text)}: must be a number of points, like 10, or a percentage, like '5%'")
        return cls(int(match[1])) if match[1] else cls(percent=float(match[2]))

    def __str__(self) -> str:
        return f"{self.number:,}" if self.percent is None else f"{self.percent:g} %"


class Reasons:
    """Reasons why points failed, by what they have in common: of each the first place and message, and how many."""

    def __init__(self) -> None:
        self.points = 0
        self.first: dict[str, tuple[str, str]] = {}
        self._numbers: dict[str, int] = {}

    def add(self, place: str, message: str) -> str:
        """Count a point that failed; return what its reason has in common with others."""
        kind = in_common(place, message)
        self.first.setdefault(kind, (place, message))
        self._numbers[kind] = self._numbers.get(kind, 0) + 1
        self.points += 1
        return kind

    def most(self) -> list[tuple[str, int]]:
        """Return what reasons have in common, the most frequent first, and how many points failed for each."""
        return sorted(self._numbers.items(), key=lambda pair: -pair[1])

    def __str__(self) -> str:
        return "; ".join(self.in_words())

    def in_words(self) -> list[str]:
        """Return the most frequent reasons, each with how many points it is of and one of them."""
        most = self.most()
        words = [self._described(kind) for kind, _ in most[:NAMED]]
        return [*words, *([f"{len(most) - NAMED:,} other reasons"] if len(most) > NAMED else [])]

    def _described(self, kind: str) -> str:
        (place, message), number = self.first[kind], self._numbers[kind]
        return (
            f"{short(message)}, at {place}"
            if number == 1
            else f"{number:,} like {short(message)}, for example at {place}"
        )


class FailureCount:
    """Counts the points of a run that have ended, and says when too many have failed.

    Without a limit that is when the first points all fail for the same reason, as where a package is missing.
    """

    def __init__(
        self, study: Study, points: int, before: int = 0, failed_before: int = 0, most: MaxFailures | None = None
    ) -> None:
        """Begin with all ``points`` of a study; ``before`` of them have ended in earlier runs, some of them failed."""
        self._study, self.points, self._before, self._most = study, points, before, most
        self._failed_before = failed_before
        # What the first points that were tried have in common with others, '' for one without a failure so far.
        self._first: dict[int, str] = {}
        self._begun: set[int] = set()
        self._reasons = Reasons()
        self.ended = 0

    def __str__(self) -> str:
        """How many points are done, and how many failed, in this run and in earlier ones."""
        if words := self.failed_in_words:
            return f"{self.done:,} done, {words} of {self.points:,} points"
        return f"{self.done:,}/{self.points:,} points"

    @property
    def done(self) -> int:
        """How many points are done."""
        return self._before + self.ended - self._failed_before - self.failed_here

    @property
    def failed_in_words(self) -> str:
        """How many points have failed, '' for none."""
        failed = self._failed_before + self.failed_here
        return f"{failed:,} failed" if failed else ""

    @property
    def failed_here(self) -> int:
        """How many points have failed in this run."""
        return self._reasons.points

    @property
    def reason(self) -> str:
        """The first reason, in short; '' where no point has failed in this run."""
        return harmless(next((short(message) for _, message in self._reasons.first.values()), ""))

    @property
    def most_at_once(self) -> int | None:
        """How many blocks a task may have, so that a run that is to be ended has not done more; None is no limit."""
        if self._most is not None:
            left = FIRST if self._most.number is None else self._most.number + 1 - self.failed_here
            return max(1, min(FIRST, left))
        return FIRST - len(self._first) or None

    def take(self, ended: Iterable[GridPoint], failed: Mapping[int, Failure], begun: Iterable[int] = ()) -> list[str]:
        """Count points that have ended, and by their indices those that have ``begun`` well; return a sentence for each
        of the first reasons.
        """
        new = []
        for index in begun:
            self._begun.add(index)
            self._note(index, "")
        for point in ended:
            self.ended += 1
            self._begun.discard(point.index)
            kind = ""
            if (failure := failed.get(point.index)) is not None:
                known = len(self._reasons.first)
                place = describe(self._study, point.parameters)
                kind = self._reasons.add(place, failure.message)
                if known < len(self._reasons.first) <= NAMED:
                    new.append(f"failed at {place}: {short(failure.message)}")
            self._note(point.index, kind)
        return new

    def _note(self, index: int, kind: str) -> None:
        if index in self._first or len(self._first) < FIRST:
            self._first[index] = kind

    def too_many(self) -> str:
        """Return why the run is to be ended, in words; '' where it goes on, or where nothing is left to do anyway."""
        here, most, tried = self.failed_here, self._most, self.ended + len(self._begun)
        if self._before + self.ended >= self.points or not here:
            return ""
        if most is None:
            kinds = set(self._first.values())
            alike = len(self._first) == FIRST and "" not in kinds and len(kinds) == 1
            return f"the first {FIRST} points all failed for the same reason: {self._reasons}" if alike else ""
        if most.percent is None:
            exceeded = here > (most.number or 0)
        else:
            exceeded = tried >= FIRST and 100.0 * here > most.percent * tried
        of_tried = f"{here:,} of the {counted(tried, 'point')} that were tried failed, more than {most}"
        return f"{of_tried}: {self._reasons}" if exceeded else ""


def reasons_of(failures: Mapping[str, str]) -> Reasons:
    """Return the reasons of failed points from messages by place.

    Messages that differ only in numbers, or in a value of their point, are one reason.
    """
    reasons = Reasons()
    for place, message in failures.items():
        reasons.add(place, message)
    return reasons


def failures_by_place(
    grid: Grid, status: NDArray[np.int8], records: Mapping[bytes, Record], most: int | None = None
) -> dict[str, str]:
    """Return the points that failed by a ``status`` that is indexed like the grid, or the first of them, by their place
    on the axes, and why, from the ``records`` of a store.
    """
    failed = np.flatnonzero(status == Status.FAILED)[:most]
    return {describe(grid.study, p.parameters): records[p.digest]["message"] for p in grid.points(failed)}


def failed_points(failures: Mapping[str, str]) -> str:
    """Return how many points failed and why, from messages by place: '3 points failed: 2 like KeyError: 'y', for
    example at sky=clear; ValueError: no sun, at sky=dark'.
    """
    return f"{counted(len(failures), 'point')} failed: {reasons_of(failures)}"


def in_common(place: str, message: str) -> str:
    """Return what a reason has in common with that of other points: its line without numbers and its point's values.

    >>> in_common("sky=dark,x=1", "no root in dark for x = 0.25")
    'no root in ... for x = ...'
    """
    line = short(message)
    for value in {pair.partition("=")[2] for pair in place.split(",")}:
        if value and not NUMBER.fullmatch(value):
            line = re.sub(rf"(?<!\w){re.escape(value)}(?!\w)", "...", line)
    return NUMBER.sub("...", line)


def failed_before(points: int) -> str:
    """Return how many points an earlier run could not compute, to follow how many are done; '' for none."""
    return f", {points:,} failed (`sweep run --retry` tries them again)" if points else ""


def short(message: str) -> str:
    """Return the first line of a message, cut where it is long."""
    line = message.strip().partition("\n")[0]
    return line if len(line) <= LONGEST_REASON else f"{line[:LONGEST_REASON]} [...]"
