"""How a run cuts its work into tasks, and when it writes what they return; no result depends on it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """The size of tasks, and how often a run writes.

    Args:
        most_blocks: the most blocks in one task, which bounds the size of its messages.
        flush_every_s: seconds after which new results are made durable, when others arrive.
        latest_flush_s: seconds after which they are made durable even if no others arrive.
        write_every_s: seconds after which the dataset is written again during a run.
        write_share: the share of a run's time that these writes may take.
        long_write_bytes: size of a dataset that takes a second or more to write: an interruption does not wait for it.
        long_write_points: the same, in points.
    """

    most_blocks: int = 1000
    flush_every_s: float = 1.0
    latest_flush_s: float = 2.0
    write_every_s: float = 5.0
    write_share: float = 0.05
    long_write_bytes: int = 2**26
    long_write_points: int = 100_000


TUNED = Tuning()
"""What runs use."""
