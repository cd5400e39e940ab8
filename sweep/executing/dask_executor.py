"""Runs tasks on a Dask client, and goes on when its workers die."""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import Any

from distributed import Future, KilledWorker

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.dask_workers import LOOK_EVERY_S, DaskWorkers
from linksweep.sweep.executing.execute import Limits, Results, Say, Take, make_task
from linksweep.sweep.executing.task import Failure, TaskResult, failed
from linksweep.sweep.executing.worker_plugin import Answer, run_on_worker
from linksweep.sweep.planning.plan import Work
from linksweep.sweep.planning.work_queue import TASK_S, TASKS_IN_FLIGHT, task_seconds
from linksweep.sweep.studies.study import Study

MOST_SENT, MOST_FETCHED = 32, 256
"""Most tasks that are sent in one message, and most results that are fetched in one."""

MAX_LOSSES = 3
"""How often a block may be with a worker that dies: in a task, in a child process, and in one of its own."""

MAX_TROUBLES = 6
"""How often a task may fail outside of the experiment before the run stops."""

FIRST_PAUSE_S = 0.25
"""Seconds before a task that failed so is tried again; each pause is twice the one before."""


@dataclass
class _Submission:
    """Work on its way to a worker: how often it was with a worker that died, how often Dask failed with it, and the
    time of the monotonic clock before which it is not sent.

    ``succeeded`` counts the tasks of the run that had succeeded when this work was last lost.
    """

    works: list[Work]
    losses: int = 0
    troubles: int = 0
    not_before: float = 0.0
    succeeded: int = 0


class DaskExecutor:
    """An executor on a Dask client.

    The work of a worker that died is done again in a child process of another one, where a block that ends its process
    ends nothing else and can be identified: no block is blamed for another.
    """

    def __init__(self, study: Study, workers: DaskWorkers, say: Say, limits: Limits, guarded: bool) -> None:
        """``guarded`` lets everything run in child processes, for workers in a process that must not be ended."""
        self._study, self._workers, self._say = study, workers, say
        self._limits, self._guarded = limits, guarded
        self._in_flight: dict[Future[Any], _Submission] = {}
        self._finished: SimpleQueue[Future[Any]] = SimpleQueue()
        self._arrived: deque[tuple[Future[Any], Answer | None]] = deque()
        self._given_up: dict[bytes, Failure] = {}
        self._told: set[str] = set()
        self._succeeded = 0

    @property
    def threads(self) -> int:
        """The threads of the workers when they were last counted, at least 1."""
        return self._workers.threads

    def __call__(self, take: Take) -> Results:
        """Run everything that ``take`` gives; begin now, not when the first result is asked for."""
        self._send_what_is_new(take)
        return self._results(take)

    def _send_what_is_new(self, take: Take) -> None:
        # in several messages, so that workers need not wait for all to be sent
        while (room := min(self._room(), MOST_SENT)) and (tasks := take(room)):
            self._send([_Submission(works) for works in tasks])

    def _results(self, take: Take) -> Results:
        retries: deque[_Submission] = deque()
        while True:
            now = time.monotonic()
            due = [submission for submission in retries if submission.not_before <= now][: self._room()]
            for submission in due:
                retries.remove(submission)
                yield from self._retry(submission)
            if not self._arrived or self._room() >= self._workers.threads:
                self._send_what_is_new(take)
            if not retries and not self._in_flight:
                return
            if not self._arrived and (first := self._next(LOOK_EVERY_S if not retries else FIRST_PAUSE_S)):
                self._arrived.extend(self._fetch_all(first))
            if not self._arrived:
                continue
            future, fetched = self._arrived.popleft()
            submission = self._in_flight.pop(future)
            answer = self._receive(future, fetched)
            if isinstance(answer, TaskResult):
                self._succeeded += 1
                self._remember(submission.works, answer)
                yield submission.works, answer
            elif not isinstance(answer, KilledWorker):
                retries.append(self._after_trouble(submission, answer))
            elif parts := list(self._after_loss(submission)):
                retries.extend(parts)
            else:
                reason = Failure("killed", f"its worker died {MAX_LOSSES} times: {answer}")
                result = _failed(self._study, submission.works, reason)
                self._remember(submission.works, result)
                yield submission.works, result

    def _room(self) -> int:
        return max(0, TASKS_IN_FLIGHT * self._workers.threads - len(self._in_flight))

    def _retry(self, submission: _Submission) -> Results:
        """Send work again, without the points that turned out meanwhile to end their process or to take too long: each
        of their blocks would cost as much again.
        """
        rest = []
        for work in submission.works:
            left = tuple(point for point in work.points if point.digest not in self._given_up)
            for point in work.points:
                if (reason := self._given_up.get(point.digest)) is not None:
                    one = [work._replace(points=(point,), cost=work.cost / len(work.points))]
                    yield one, _failed(self._study, one, reason)
            if left:
                rest.append(work._replace(points=left, cost=work.cost * len(left) / len(work.points)))
        if rest:
            self._send([replace(submission, works=rest)])

    def _remember(self, works: list[Work], result: TaskResult) -> None:
        points = [point for work in works for point in work.points]
        for row, failure in result.failures.items():
            if failure.kind in ("killed", "time limit"):
                self._given_up.setdefault(points[row].digest, failure)

    def _send(self, submissions: Sequence[_Submission]) -> None:
        """Send work in one message; all of it was with a worker that died equally often."""
        seconds = task_seconds(self._workers.threads)
        enough_s = 2.0 * seconds if seconds > TASK_S else 0.0
        futures = self._workers.client.map(
            run_on_worker,
            [make_task(self._study, submission.works, self._limits, enough_s) for submission in submissions],
            expected=self._workers.expected,
            guarded=self._guarded or submissions[0].losses > 0,
            memory_limit=self._limits.memory,
            pure=False,
        )
        for future, submission in zip(futures, submissions, strict=True):
            self._in_flight[future] = submission
            future.add_done_callback(self._finished.put)

    def _after_loss(self, submission: _Submission) -> Iterator[_Submission]:
        """Yield what is to be tried after the death of a worker: the same work in a child process, then each block in
        one of its own, then nothing.

        Raises SweepError where workers die and nothing else succeeds: that is no proof against a block.
        """
        losses = submission.losses + 1
        if losses < MAX_LOSSES:
            blocks = sum(len(work.points) for work in submission.works)
            said = "one block" if blocks == 1 else f"{blocks} blocks"
            self._say(f"a worker died that had {said}; a child process of another one does them again ({losses})")
            groups = [submission.works] if losses == 1 else [[work] for work in submission.works]
            yield from (replace(submission, works=works, losses=losses, succeeded=self._succeeded) for works in groups)
        elif submission.succeeded == self._succeeded:
            raise SweepError(
                f"the workers of {self._workers.where} die whatever they do; no point is blamed for it, what was "
                "finished is kept, the same command goes on from there"
            )

    def _after_trouble(self, submission: _Submission, error: BaseException) -> _Submission:
        """Return what is to be tried after an error that is not the experiment's; raises SweepError after too many."""
        troubles = submission.troubles + 1
        what = f"{type(error).__name__}: {error}"
        if troubles >= MAX_TROUBLES:
            raise SweepError(
                f"a task on {self._workers.where} failed {troubles} times outside of the experiment, last with {what}; "
                "no point is blamed for it, what was finished is kept, the same command goes on from there"
            ) from error
        if what not in self._told:
            self._told.add(what)
            self._say(f"warning: a task failed outside of the experiment ({what}); it is tried again")
        pause = FIRST_PAUSE_S * 2.0 ** (troubles - 1)
        return replace(submission, troubles=troubles, not_before=time.monotonic() + pause)

    def _next(self, timeout: float) -> Future[Any] | None:
        """Return a future that has ended, None if there was none for a while; watch the workers meanwhile."""
        self._workers.look_if_due()
        try:
            return self._finished.get(timeout=timeout)
        except Empty:
            return None

    def _fetch_all(self, first: Future[Any]) -> Iterator[tuple[Future[Any], Answer | None]]:
        """Yield all futures that have ended with their results, which come in one message: one by one each would cost
        a round trip to the worker.  None for a result that is to be fetched by itself, since it or another failed.
        """
        futures = [first]
        while len(futures) < MOST_FETCHED and not self._finished.empty():
            futures.append(self._finished.get())
        good = [future for future in futures if future.status == "finished"]
        answers: list[Answer] = []
        if len(good) > 1:
            with suppress(Exception):
                answers = self._workers.fetch(good).result(LOOK_EVERY_S)
        known = dict(zip(good, answers, strict=False))
        yield from ((future, known.get(future)) for future in futures)

    def _receive(self, future: Future[Any], fetched: Answer | None) -> TaskResult | BaseException:
        """Return a task's result, or the error with which Dask lost it; what the experiment raises is in the result."""
        try:
            answer = fetched or self._workers.result(future)
        except SweepError:
            raise
        except ImportError as error:
            raise self._workers.unable(error) from error
        except Exception as error:
            if self._workers.client.status != "running":
                raise self._workers.gone() from error
            return error
        finally:
            future.release()
        self._workers.warn(answer.worker, answer.others)
        if answer.result is None:
            raise SweepError([f"{answer.worker}: {text}" for text in answer.deciding], "a worker that differs")
        return answer.result


def _failed(study: Study, works: list[Work], reason: Failure) -> TaskResult:
    return failed(sum(len(work.points) for work in works), study.experiment.sums_width, reason)
