"""Same seed, same numbers, bitwise: whatever the workers, the order and the interruptions.  All with real processes."""

from contextlib import closing

import pytest
import xarray as xr

from tests.sweep.outside import Outside
from tests.tiers import slow


def results(store):
    return xr.open_zarr(store).load().drop_vars("wall_time").drop_attrs()


@pytest.mark.parametrize(
    "resources",
    [
        *(pytest.param(("--workers", n), marks=pytest.mark.slow) for n in (1, 4)),
        ("--workers", 2),
        slow(("--pool", "threads", "--workers", 4)),
    ],
    ids=["1 process", "4 processes", "2 processes", "4 threads"],
)
def test_any_number_of_workers(link_study, tmp_path, sweep, reference, resources):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", *resources)
    assert code == 0, err
    xr.testing.assert_identical(results(tmp_path / "s.zarr"), reference)


@pytest.fixture
def scheduler(tmp_path):
    """The address of a Dask scheduler with two worker processes, all of them started from the command line."""
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask")) as outside:
        outside.start_worker("--nworkers", "2")
        yield outside.address


@pytest.mark.slow
def test_a_scheduler_that_runs_elsewhere(link_study, tmp_path, sweep, reference, scheduler):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--scheduler", scheduler)
    assert code == 0, err
    assert scheduler in err
    xr.testing.assert_identical(results(tmp_path / "s.zarr"), reference)
