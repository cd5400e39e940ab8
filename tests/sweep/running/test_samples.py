"""Samples that a study keeps."""

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import SweepError
from tests.sweep.opening import OFTEN, dying, run, same, until_done

LINK = {
    "title": "Samples",
    "axes": {"n_obj": [20, 30]},
    "fixed": {"catalogue": "quasars", "v_max": 15.0},
    "sampling": {"n_sim": 520, "n_cat": 20, "seed": 5, "keep_samples": True},  # two parts, two groups
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The store of a study that keeps its samples; only read."""
    store = tmp_path_factory.mktemp("samples") / "s.zarr"
    run(LINK, store)
    return store


@pytest.fixture
def kept(store):
    return linksweep.open(store)


def test_samples_are_the_realisations_behind_the_results(kept):
    estimate = kept["estimate"]
    assert estimate.dims == ("n_obj", "sample", "component")
    assert estimate.sizes["sample"] == 10_400
    error = estimate - 1.0  # the truth is 1 in every component
    xr.testing.assert_allclose(np.sqrt((error**2).mean("sample")), kept["sigma"], rtol=1e-9)
    xr.testing.assert_allclose(error.mean("sample"), kept["bias"], rtol=1e-6)
    assert len(np.unique(estimate.isel(n_obj=0, component=0))) == 10_400


def test_samples_are_the_same_after_a_kill(kept, tmp_path, monkeypatch):
    left = dying(monkeypatch)
    found, killed = until_done(left, 60, lambda: run(LINK, tmp_path / "other.zarr", OFTEN))
    assert killed
    same(found, kept)


def test_an_experiment_without_samples_cannot_keep_them(coins, tmp_path):
    with pytest.raises(SweepError, match="has no samples to keep"):
        run(coins | {"sampling": {"keep_samples": True}}, tmp_path / "s.zarr")


def test_keeping_samples_is_part_of_what_a_store_means(store):
    without = LINK | {"sampling": {**LINK["sampling"], "keep_samples": False}}
    with pytest.raises(SweepError, match="keep_samples"):
        run(without, store)
