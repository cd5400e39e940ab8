"""Points whose code forks, raises what is no Exception, or an exception that cannot say what it is."""

import os
import sys
import threading

import pytest

from linksweep import run
from sweep.executing.own_process import forks_ended
from sweep.interrupt import RunInterruptedError


def statuses(function, folder, **options):
    ds = run(function, folder / "s.zarr", axes={"x": [1.0, 2.0, 3.0]}, **{"pool": "serial", **options})
    return ds.status.values.tolist(), ds.attrs.get("failures", "")


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no words")

    __repr__ = __str__


@pytest.mark.parametrize(
    ("error", "said"),
    [(GeneratorExit(), "GeneratorExit"), (MuteError(), "MuteError: its message cannot be made: RuntimeError")],
    ids=["GeneratorExit", "a message that raises"],
)
def test_a_point_that_raises_anything_fails_alone(error, said, tmp_path):
    def f(x: float):
        if x == 2.0:
            raise error
        return x

    found, failures = statuses(f, tmp_path)
    assert found == [1, 2, 1]
    assert said in failures


def test_a_keyboard_interrupt_that_is_the_function_s_fails_its_point(tmp_path):
    def f(x: float):
        if x == 2.0:
            raise KeyboardInterrupt
        return x

    found, failures = statuses(f, tmp_path, pool="threads", workers=1)
    assert found == [1, 2, 1]
    assert "KeyboardInterrupt" in failures


def test_in_the_main_thread_it_is_the_user_s(tmp_path):
    def f(x: float):
        raise KeyboardInterrupt

    assert threading.current_thread() is threading.main_thread()
    with pytest.raises(RunInterruptedError):
        statuses(f, tmp_path)


@pytest.mark.parametrize(
    ("ending", "code"),
    [(lambda: None, 0), (sys.exit, 0), (lambda: sys.exit(3), 3), (lambda: sys.exit("why"), 1), (max, 1)],
    ids=["returns", "exits", "exits with a code", "exits with a sentence", "raises"],
)
def test_a_forked_child_that_leaves_the_block_ends(ending, code, tmp_path):
    mark = tmp_path / "went on"
    with forks_ended():
        if not (child := os.fork()):
            ending()
    if not child:
        mark.touch()  # the child must never be here
        os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == code
    assert not mark.exists()


def test_a_child_that_a_function_forks_and_forgets_does_not_go_on_with_the_run(tmp_path):
    mark = tmp_path / "mark"

    def f(x: float):
        child = os.fork()
        if not child:
            raise ValueError("of the child")
        os.waitpid(child, 0)
        with mark.open("a") as file:
            file.write(f"{x:g}\n")
        return x

    assert statuses(f, tmp_path)[0] == [1, 1, 1]
    assert mark.read_text() == "1\n2\n3\n"
