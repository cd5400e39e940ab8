"""A clock that is set back must not stop a run: Dask's streams wait for a time of the day between two messages.

In the milliseconds after a message a stream keeps the next ones back until a time by the clock (`BatchedSend` of
distributed).  Set back by a day just then, the clock reaches that time a day later.
"""

import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from distributed import Client
from distributed.batched import BatchedSend

STEP_S = 1.0
"""So far back counts; less is waited for."""


class Clock:
    """Tells when the clock of this machine has been set back, which on a cluster happens to all of them at once."""

    def __init__(self) -> None:
        self._ahead = self._now()

    def was_set_back(self) -> bool:
        """Whether it was since this was asked last."""
        before, self._ahead = self._ahead, self._now()
        return self._ahead < before - STEP_S

    @staticmethod
    def _now() -> float:
        return time.time() - time.monotonic()


def wake(client: Client) -> None:
    """Let every stream between client, scheduler and workers send at once what it keeps back.

    The calls that bring this there do not go through such streams.
    """
    assert client.loop is not None
    client.loop.add_callback(_wake, [client.scheduler_comm])
    with suppress(Exception):  # a scheduler that runs nothing for clients
        client.run_on_scheduler(_wake_scheduler)
        client.run(_wake_worker, on_error="ignore")


def _wake(streams: Iterable[BatchedSend]) -> None:
    for stream in streams:
        stream.next_deadline = None
        stream.waker.set()


def _wake_scheduler(dask_scheduler: Any) -> None:
    _wake([*dask_scheduler.stream_comms.values(), *dask_scheduler.client_comms.values()])


def _wake_worker(dask_worker: Any) -> None:
    _wake([dask_worker.batched_stream])
