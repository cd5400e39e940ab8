"""A function over many pieces, as `tie` has them: the driver of runs, results in the order of the pieces."""

import os
import signal
import time

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import mapped
from linksweep.sweep.executing.pools import Limits, Resources

EXPERIMENT = "linksweep.core.experiment:link"


def slept(seconds):
    time.sleep(seconds)
    return seconds


@pytest.mark.parametrize("resources", [Resources(), Resources(pool="threads", workers=3)], ids=["here", "threads"])
def test_results_come_in_the_order_of_the_pieces(resources):
    seconds = [0.1, 0.0, 0.05, 0.0, 0.0]
    with mapped(EXPERIMENT, resources, print) as run:
        assert list(run(slept, [(one,) for one in seconds])) == seconds
        assert list(run(pow, [])) == []
        with pytest.raises(ZeroDivisionError):
            list(run(divmod, [(1, 1), (1, 0)]))
        assert list(run(divmod, [(7, 2)])) == [(3, 1)]


def died_once(path, number):
    if number == 3 and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.slow
def test_the_piece_of_a_worker_that_dies_is_computed_by_another(tmp_path):
    with mapped(EXPERIMENT, Resources(workers=2), print) as run:
        assert list(run(died_once, [(tmp_path / "died", n) for n in range(8)])) == list(range(8))


@pytest.mark.slow
def test_limits_hold_for_pieces():
    limits = Limits(time_s=0.5)
    with (
        pytest.raises(SweepError, match=r"longer than the time limit of 0\.5 s"),
        mapped(EXPERIMENT, Resources(workers=1, limits=limits), print) as run,
    ):
        list(run(busy, [(60.0,)]))
    with (
        pytest.raises(SweepError, match="need worker processes"),
        mapped(EXPERIMENT, Resources(pool="threads", limits=limits), print),
    ):
        pass


def busy(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass
