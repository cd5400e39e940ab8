"""How a run cuts its work into tasks, and when it writes what they return: no number depends on it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """What a run takes its time for.

    Args:
        most_blocks: in one task, which bounds the size of its messages.
        flush_every_s: seconds after which new results are made durable, when others come in.
        latest_flush_s: seconds after which they are although none comes in.
        write_every_s: seconds after which the dataset is written again on the way.
        write_share: the share of a run's time that these writings may take.
        long_write_bytes: of a dataset whose writing takes a second or more: an interruption does not wait for it.
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
