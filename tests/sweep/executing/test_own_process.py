"""Points whose code forks, raises what is no Exception, or an exception that cannot say what it is."""

import decimal
import os
import random
import sys
import threading
import warnings

import numpy as np
import pytest

from linksweep import run
from tests.sweep.opening import RunInterruptedError
from tests.tiers import slow


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


def test_in_the_main_thread_it_is_the_user_s(tmp_path):
    def f(x: float):
        raise KeyboardInterrupt

    assert threading.current_thread() is threading.main_thread()
    with pytest.raises(RunInterruptedError):
        statuses(f, tmp_path)


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
    marks = mark.read_text().split()  # the first point is computed twice where that is quick
    assert [marks.count(x) for x in "23"] == [1, 1]


CHANGES = {
    "folder": (lambda: os.chdir("/"), os.getcwd),
    "arithmetic": (lambda: np.seterr(all="raise"), lambda: str(np.float64(1.0) / np.float64(0.0) > 1.0)),
    "decimals": (lambda: setattr(decimal.getcontext(), "prec", 3), lambda: str(decimal.Decimal(1) / 3)),
    "environment": (os.environ.clear, lambda: str(sorted(os.environ.items()))),
    "one more": (lambda: os.environ.update(LINKSWEEP_X="1"), lambda: str("LINKSWEEP_X" in os.environ)),
    "random": (lambda: random.seed(1), lambda: str(random.getstate() == random.Random(1).getstate())),
    "numpy": (lambda: np.random.seed(1), lambda: str(np.random.get_state()[1][0] == 1)),  # noqa: NPY002
    "filters": (lambda: warnings.simplefilter("error"), lambda: str(warnings.warn("w", stacklevel=1))),
    "output": (lambda: setattr(sys, "stdout", None), lambda: str(print("x"))),
    "errors": (lambda: setattr(sys, "stderr", None), lambda: str(print("", end="", file=sys.stderr))),
}
"""What one point changes of its process, and what the others look at."""


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("options", [slow({"pool": "serial"}), slow({"pool": "threads", "workers": 1}), {}], ids=str)
def test_what_a_point_changes_is_put_back_for_the_others(change, options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    change_it, look = CHANGES[change]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = look()

    def f(x: float):
        if x in (1.0, 4.0):
            change_it()
            return "changed"
        return look()

    def outside():  # threads of Dask draw from the generators
        generators = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
        return os.getcwd(), dict(os.environ), sys.stderr, generators if options.get("pool") != "threads" else ()

    before = outside()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ds = run(f, "s.zarr", axes={"x": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]}, **options)
    assert ds.status.values.tolist() == [1] * 6, ds.attrs["failures"]
    assert ds.f.values.tolist() == [expected, "changed", expected, expected, "changed", expected]
    assert before == outside()
    assert (tmp_path / "s.zarr").is_dir()


@pytest.mark.parametrize("options", [{"pool": "threads", "workers": 2}, slow({"workers": 2}), {}], ids=str)
def test_global_generators_give_the_same_on_all_pools_and_another_number_at_each_point(options, tmp_path):
    def f(rng: np.random.Generator, x: float):
        return np.random.normal() + random.random()  # noqa: NPY002

    def values(store, **options):
        axes = {"x": [1.0, 2.0, 3.0]}
        return run(f, tmp_path / store, axes=axes, sampling={"n_sim": 10, "seed": 3}, **options).f_mean.values.tolist()

    found = values("s.zarr", pool="serial")
    assert len(set(found)) == 3
    assert values("other.zarr", **options) == found
