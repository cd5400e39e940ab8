"""A part of a study: one of several shares of its work, which are computed without each other and merged afterwards."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import count, groupby

from linksweep.sweep.contract import shown

# The attribute of a store that says which part of a study it holds.
PART = "part"

# The attribute of a merged store with the numbers of the parts that lack a block, in words.
LOST = "lost_parts"

MOST_PARTS = 100_000

# What SLURM sets for the tasks of a job array.
TASK = "SLURM_ARRAY_TASK_ID"


@dataclass(frozen=True, order=True)
class Part:
    """The part with a ``number``, from 1, of so many in ``total``; as text 3/100."""

    total: int
    number: int

    @classmethod
    def parsed(cls, text: str) -> "Part":
        """Return the part that a user names; raises ValueError for anything else.

        >>> Part.parsed("3/100")
        Part(total=100, number=3)
        """
        match = re.fullmatch(r"\s*(\d{1,6})\s*/\s*(\d{1,6})\s*", str(text))
        number, total = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= number <= total <= MOST_PARTS:
            raise ValueError(f"{shown(text)}: must be K/N, part K from 1 to N, of N parts from 1 to {MOST_PARTS:,}")
        return cls(total, number)

    @classmethod
    def of_task(cls, environment: Mapping[str, str]) -> "Part":
        """Return the part of a task of a job array of SLURM, whose first task has part 1 whatever its number; raises
        ValueError where this is none, and for an array with gaps, which is some tasks of a larger one.
        """
        names = (TASK, "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_MAX", "SLURM_ARRAY_TASK_COUNT")
        task, first, last, tasks = (int(text) if (text := environment.get(n, "")).isdecimal() else -1 for n in names)
        instead = f"; name the part, as in --part ${TASK}/100"
        if min(task, first, last, tasks) < 0:
            raise ValueError(f"array: {', '.join(names)} do not say which task of a job array this is{instead}")
        if last - first + 1 != tasks:
            raise ValueError(
                f"array: {tasks} tasks from {first} to {last} do not say how many parts there are{instead}"
            )
        return cls.parsed(f"{task - first + 1}/{tasks}")

    def __str__(self) -> str:
        return f"{self.number}/{self.total}"

    def place(self, store: object) -> str:
        """Return where this part of a store is."""
        return f"{store}.part-{self.number}-of-{self.total}"

    @classmethod
    def named(cls, place: object) -> "Part | None":
        """Return the part whose `place` it is by its name, None for another place."""
        match = re.search(r"\.part-([1-9]\d{0,5})-of-([1-9]\d{0,5})$", str(place))
        return cls(int(match[2]), int(match[1])) if match else None


def in_ranges(numbers: Iterable[int]) -> str:
    """Return whole numbers in ascending order, neighbours joined.

    >>> in_ranges([7, 1, 2, 3])
    '1-3, 7'
    """
    places = count()
    runs = [list(run) for _, run in groupby(sorted(numbers), key=lambda number: number - next(places))]
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
