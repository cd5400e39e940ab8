"""What a block of work leaves of a point: its key and its row, how two rows are joined, and what comes out at the end;
in which chunks large arrays are stored; the status of a point, as stores and datasets hold it.
"""

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from linksweep.sweep.formatting import counted

Array = NDArray[np.float64]
# What blocks left of points: a NumPy structured array of `Reducer.dtype`, one element for each.
Rows = NDArray[np.void]

# Fewest independent samples (catalogues, mostly) whose scatter gives an error: with fewer it is not known.
FEWEST_SAMPLES = 5

# Up to here a float holds every integer exactly.
EXACT_INT = 2**53

# What is in place of a missing time; of a missing integer too, unless a value is like it.
MISSING_INT = int(np.iinfo(np.int64).min)

# What is in place of a missing integer in large arrays, whose values are not looked through: a number without meaning.
MISSING_LARGE_INT = MISSING_INT + 3**39

# The end of the name of the field of a row, or of a variable, that has the length of an array.
LENGTH = "_length"


class Outcome(NamedTuple):
    """What a block left of one point: the fields of a row, with the realisations that are ``kept``, (n, width), and for
    results that nobody declared with the ``layout`` that says what the fields are.
    """

    row: Any
    kept: Array | None = None
    layout: Any = None


class Reducer(ABC):
    """What a block of work leaves of a point, how two blocks are joined, and what comes out at the end; by default one
    block alone leaves its row.
    """

    @property
    @abstractmethod
    def dtype(self) -> np.dtype[np.void]:
        """The type of a row, with a field for each quantity."""

    @property
    def samples_width(self) -> int:
        """How many floats of each realisation the result of a point needs besides its row."""
        return 0

    def add(self, total: Rows, block: Rows) -> Rows:
        """Return the rows of points, (points,), with one block more each; ``total`` is zero before the first."""
        return block

    def close(self, total: Rows, samples: Array) -> Rows:
        """Return the row of a point, (1,), with what its samples (n, samples_width) add at the end."""
        return total

    @abstractmethod
    def finish(self, total: Rows, n: Array, n_cat: Array) -> dict[str, NDArray[Any]]:
        """Return every output, (points, *shape), from rows over ``n`` realisations of ``n_cat`` catalogues, (points,).

        Raises ResultError for outputs that are not as declared, and whatever an experiment raises.
        """


def converted(rows: Rows, dtype: np.dtype[np.void]) -> Rows:
    """Return rows with the fields of another type, zero where they had none of that name."""
    if rows.dtype == dtype:
        return rows
    table = np.zeros(len(rows), dtype=dtype)
    for name in set(rows.dtype.names or ()) & set(dtype.names or ()):
        table[name] = padded(rows[name], table[name].shape)
    return table


def padded(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array with zeros, or empty texts, after the ends of those of its axes that are shorter than a shape."""
    if array.shape == shape:
        return array
    whole = np.full(shape, "", dtype=object) if array.dtype.hasobject else np.zeros(shape, dtype=array.dtype)
    whole[tuple(map(slice, array.shape))] = array
    return whole


def lost_integers(rows: Rows, dtype: np.dtype[np.void]) -> dict[int, str]:
    """Return which rows have an integer that the floats of a new type cannot hold, and why that is wrong."""
    lost: dict[int, str] = {}
    for name in set(rows.dtype.names or ()) & set(dtype.names or ()):
        if len(rows) and rows.dtype[name].base.kind == "i" and dtype[name].base.kind == "f":
            whole = rows[name].reshape(len(rows), -1)
            for row in np.flatnonzero(_beyond(whole).any(axis=1)).tolist():
                number = beyond_floats(whole[row])
                lost[row] = f"{name!r} is {number}, which is beyond 2**53, and is to be a float"
    return lost


def beyond_floats(value: Any) -> int | None:
    """Return the first of some integers beyond 2**53, not all of which are floats; None where there is none."""
    whole = np.asarray(value).reshape(-1)
    wrong = _beyond(whole)
    return int(whole[wrong][0]) if wrong.any() else None


def _beyond(whole: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (whole > EXACT_INT) | (whole < -EXACT_INT)


def same_rows(one: Rows, other: Rows) -> bool:
    """Return whether rows are of one type and have the same bits, and the same texts."""
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    pairs = [(one[name], other[name]) for name in one.dtype.names or ()]
    return all(a.tolist() == b.tolist() if a.dtype.hasobject else a.tobytes() == b.tobytes() for a, b in pairs)


def small_sample_factor(samples: ArrayLike) -> Array:
    """Return the factor that enlarges a variance from the scatter of so many independent samples.

    For normal samples, the error of their mean over the root of that variance then has variance one; without the factor
    it is Student's t with n - 1 degrees of freedom, of variance (n - 1)/(n - 3).  NaN below `FEWEST_SAMPLES`, 1 for
    infinitely many.
    """
    count = np.asarray(samples, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = 1.0 + 2.0 / (count - 3.0)
    return np.where(count >= FEWEST_SAMPLES, factor, np.nan)


def enlarged_error(square: Array, samples: ArrayLike, skewness: Array) -> Array:
    """Return the error of a mean from its ``square``, as the scatter of so many samples gives it, enlarged where few
    look too much alike: by the small-sample factor, and by their ``skewness``, squared and over their number.
    """
    return np.asarray(np.sqrt(square * small_sample_factor(samples) * (1.0 + 6.0 * skewness)))


def p_value(chi2: float, dof: int, samples: float = np.inf, scaled: float = np.inf) -> float:
    """Return the probability of a chi2 at least as large by chance; NaN without degrees of freedom.

    With a covariance estimated from ``samples``, chi2 is Hotelling's T^2, which has an F distribution.  So it has with
    a covariance that was scaled by another chi2 over its ``scaled`` degrees of freedom.
    """
    from scipy.special import chdtrc, fdtrc  # takes a tenth of a second, and most studies need neither

    if np.isinf(samples) and np.isinf(scaled):
        return float(chdtrc(dof, chi2)) if dof > 0 else np.nan
    left, part = (scaled, 1.0) if np.isinf(samples) else (samples - dof, (samples - dof) / (samples - 1.0))
    return float(fdtrc(dof, left, chi2 / dof * part)) if dof > 0 < left else np.nan


# Bytes in a `ledger_key`.
KEY_BYTES = 32

# Bytes of the digest of a point, with which a key begins.
DIGEST_BYTES = 16


class Block(NamedTuple):
    """A point's realisations ``part`` of the catalogues of one ``group``: the unit of work, ledger and resuming.

    Catalogues are numbered from ``first_catalogue``; each gets ``n_sim`` realisations from a stream of its own.

    >>> Block(group=0, part=1, first_catalogue=0, n_cat=16, n_sim=512).realisations
    8192
    """

    group: int
    part: int
    first_catalogue: int
    n_cat: int
    n_sim: int

    @property
    def realisations(self) -> int:
        """Realisations in this block."""
        return self.n_cat * self.n_sim


def ledger_key(digest: bytes, block: Block) -> bytes:
    """Return the key of a block in the ledger, 32 bytes: digest, group, part, catalogues, realisations of each.

    Two runs agree on a key if and only if the block leaves the same numbers.
    """
    return digest + struct.pack("<4I", block.group, block.part, block.n_cat, block.n_sim)


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


# In place of the key of a row that was lost.
NO_KEY = bytes(KEY_BYTES)


class BlockRows(dict[bytes, int]):
    """The rows of a ledger by the keys of their blocks; the last row of a key counts, and no row with `NO_KEY`."""

    def __init__(self, keys: Sequence[bytes] = ()) -> None:
        super().__init__()
        # The row that the next key gets.
        self.end = 0
        self.extend(keys)

    def extend(self, keys: Sequence[bytes]) -> None:
        """Add the rows that follow the last one."""
        self.update(zip(keys, range(self.end, self.end + len(keys)), strict=True))
        self.pop(NO_KEY, None)
        self.end += len(keys)

    def keys_of_rows(self) -> list[bytes]:
        """Return the key of each row, `NO_KEY` for one that does not count."""
        keys = [NO_KEY] * self.end
        for key, row in self.items():
            keys[row] = key
        return keys


# The most values of a chunk of results, 8 MB of floats.  Values are counted and not bytes, so that results on the same
# axes have the same chunks whatever their types, as Dask wants.
MOST_VALUES = 2**20

# What a row has in place of each chunk of a large array: the checksum of its file; zeros are none.
REFERENCE = np.dtype("V16")


def absent(dtype: np.dtype[Any]) -> float:
    """Return what a large array of numbers has where they are missing."""
    return np.nan if dtype.kind == "f" else MISSING_LARGE_INT


def is_large(shape: Sequence[int]) -> bool:
    """Return whether an array of this shape at a point is large: no chunk has two points."""
    return math.prod(shape) > MOST_VALUES // 2


def chunk_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Return a shape for chunks of at most `MOST_VALUES` that are whole in the last dimensions: a point's values stay
    together, and a coordinate is one chunk.
    """
    chunk = list(shape)
    for axis in range(len(chunk)):
        rest = math.prod(chunk[axis + 1 :])
        chunk[axis] = max(1, min(chunk[axis], MOST_VALUES // max(1, rest)))
        if chunk[axis] > 1:
            break
    return tuple(chunk)


def chunk_grid(shape: Sequence[int]) -> tuple[int, ...]:
    """Return how many chunks an array of this shape has along each dimension."""
    return tuple(-(-n // size) for n, size in zip(shape, chunk_shape(shape), strict=True))
