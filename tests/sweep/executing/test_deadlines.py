"""Time limits inside a process; what ends a process is tested in `test_isolated`."""

import signal
import threading
import time
from contextlib import suppress

import pytest

from linksweep.sweep.executing.worker import Deadlines, TimeLimitError
from tests.tiers import PATIENCE_S, examples


@pytest.fixture(autouse=True)
def no_end_by_the_alarm():
    """On a machine that stands still for seconds the alarm would end the process of the tests."""
    before = signal.signal(signal.SIGALRM, lambda number, frame: None)
    yield
    signal.signal(signal.SIGALRM, before)


def busy(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def test_a_loop_is_ended_and_a_block_that_ends_as_its_bell_rings_leaves_nothing_behind():
    deadlines = Deadlines()
    with pytest.raises(TimeLimitError), deadlines.within(0.02):
        busy(60)
    blocks = in_time = 0
    while blocks < examples(300) or not in_time:  # a machine that is slow for a while ends many
        blocks += 1
        with suppress(TimeLimitError):
            with deadlines.within(0.002):
                busy(0.0018)
            in_time += 1
        busy(0.001)  # an exception that came late would leave the test here
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_the_alarm_is_set_to_the_first_end_of_all_threads():
    deadlines = Deadlines()
    inside, leave = threading.Barrier(3), threading.Barrier(3)

    def block(seconds):
        with deadlines.within(seconds):
            inside.wait(PATIENCE_S)
            leave.wait(PATIENCE_S)

    threads = [threading.Thread(target=block, args=(seconds,)) for seconds in (1000, 3000)]
    for thread in threads:
        thread.start()
    inside.wait(PATIENCE_S)
    assert 900 < signal.getitimer(signal.ITIMER_REAL)[0] <= 1002
    leave.wait(PATIENCE_S)
    for thread in threads:
        thread.join(PATIENCE_S)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
