"""The status of a point, as stores and datasets hold it."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from linksweep.sweep.formatting import counted


class Status(IntEnum):
    """Where the computation of a point stands.  Stores have running points as missing ones: see `with_running`."""

    MISSING = 0
    DONE = 1
    FAILED = 2
    EXCLUDED = 3
    RUNNING = 4

    @property
    def word(self) -> str:
        """The status in lower case, as tables and datasets spell it."""
        return self.name.lower()


def count_status(status: Any) -> dict[Status, int]:
    """Return how many points of an array have each status, zeros included unless none is running.

    Examples:
        >>> {code.word: n for code, n in count_status([1, 1, 0]).items()}
        {'missing': 1, 'done': 2, 'failed': 0, 'excluded': 0}
    """
    counts = {code: int(np.count_nonzero(np.asarray(status) == code)) for code in Status}
    return {code: n for code, n in counts.items() if n or code != Status.RUNNING}


def progress_in_words(done: int, failed: int, points: int, part: str = "") -> str:
    """Return how many points, of a ``part`` or of all, are done and how many failed.

    Examples:
        >>> progress_in_words(2, 0, 3), progress_in_words(1, 1, 2, " of part 1/3")
        ('2 of 3 points done', '1 of 2 points of part 1/3 done, 1 failed')
    """
    return f"{done:,} of {counted(points, 'point')}{part} done{f', {failed:,} failed' if failed else ''}"


def unfinished_in_words(counts: Mapping[Status, int]) -> str:
    """Return how many points are neither done nor excluded, by status, in words; '' if there is none.

    Examples:
        >>> unfinished_in_words(count_status([1, 1, 0, 2, 2]))
        '1 missing and 2 failed'
    """
    undone = (Status.RUNNING, Status.MISSING, Status.FAILED)
    return " and ".join(f"{counts[code]} {code.word}" for code in undone if counts.get(code))
