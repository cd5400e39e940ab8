"""Samples that a study keeps."""

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import SweepError
from tests.sweep.opening import Resources, Store, Tuning, run_study, study_from_dict

SERIAL = Resources(pool="serial")
LINK = {
    "title": "Samples",
    "axes": {"model": ["amex", "gaia"], "n_obj": [20, 30]},
    "fixed": {"catalogue": "quasars", "v_max": 15.0},
    "sampling": {"n_sim": 700, "n_cat": 20, "seed": 5, "keep_samples": True},  # two parts, two groups
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The store of a study that keeps its samples; only read."""
    store = tmp_path_factory.mktemp("samples") / "s.zarr"
    assert not run_study(study_from_dict(LINK), store, SERIAL)[1]
    return store


@pytest.fixture
def kept(store):
    return linksweep.open(store)


def test_samples_are_the_realisations_behind_the_results(kept):
    estimate = kept["estimate"]
    assert estimate.dims == ("model", "n_obj", "sample", "component")
    assert estimate.sizes["sample"] == 14_000
    error = estimate - 1.0  # the truth is 1 in every component
    xr.testing.assert_allclose(np.sqrt((error**2).mean("sample")), kept["sigma"], rtol=1e-9)
    xr.testing.assert_allclose(error.mean("sample"), kept["bias"], rtol=1e-6)
    assert len(np.unique(estimate.isel(model=0, n_obj=0, component=0))) == 14_000


def test_samples_are_the_same_in_any_order_and_after_a_kill(kept, tmp_path):
    study = study_from_dict(LINK)
    store = tmp_path / "other.zarr"
    write = Store.write
    with pytest.MonkeyPatch.context() as patch:
        calls = []

        def killed(self, dataset):
            calls.append(dataset)
            if len(calls) == 3:
                raise SystemExit("killed")
            write(self, dataset)

        patch.setattr(Store, "write", killed)
        often = Tuning(most_blocks=1, flush_every_s=-1.0, write_every_s=-1.0, write_share=1e9)
        with pytest.raises(SystemExit):
            run_study(study, store, SERIAL, tuning=often)
    again, _ = run_study(study, store, Resources(workers=2, pool="threads"))
    xr.testing.assert_identical(again.drop_vars("wall_time").drop_attrs(), kept.drop_vars("wall_time").drop_attrs())


def test_an_experiment_without_samples_cannot_keep_them(coins):
    with pytest.raises(SweepError, match="has no samples to keep"):
        study_from_dict(coins | {"sampling": {"keep_samples": True}})


def test_keeping_samples_is_part_of_what_a_store_means(store):
    without = LINK | {"sampling": {**LINK["sampling"], "keep_samples": False}}
    with pytest.raises(SweepError, match="keep_samples"):
        run_study(study_from_dict(without), store, SERIAL)
