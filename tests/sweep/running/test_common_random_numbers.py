"""Points that differ only in what is made of random numbers draw the same ones, and stay what they are alone."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from astropy import units as u

from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.running.results import squared
from linksweep.sweep.running.run import run_study
from linksweep.sweep.studies.reader import study_from_dict
from tests.tiers import slow

SERIAL = Resources(pool="serial")


def evaluate(points, n_sim, rng, catalogue_rng):
    """Sums of z + w x for two normals z and w, where x is the point's mixing; z and w are drawn once for all points."""
    z, w = rng.standard_normal((2, n_sim))
    drawn = [p["scale"] * (z + p["mixing"] * w) for p in points]
    return {"sum": [d.sum() for d in drawn], "squares": [(d**2).sum() for d in drawn]}


def summary(sums, n, n_cat):
    mean = sums["sum"] / n
    return {"mean": mean, "mean_mc_error": np.sqrt((sums["squares"] / n - mean**2) / n)}


experiment = Experiment(
    name="mixed",
    version=1,
    parameters=(
        Parameter("mixing", "float", 0.0, "how much of the other"),
        Parameter("scale", "float", 1.0, "factor", above=0.0),
        Parameter("kind", "str", "a", "another draw", choices=("a", "b")),
    ),
    sums={"sum": (), "squares": ()},
    outputs=(Output("mean", "m", "mean", headline=True), Output("mean_mc_error", "m", "its error")),
    evaluate=evaluate,
    summarise=summary,
    shared=("mixing", "scale"),
)


def document(axes, **sampling):
    return {
        "title": "Mixed",
        "experiment": f"{__file__}:experiment",
        "axes": axes,
        "sampling": {"n_sim": 512, "n_cat": 40, "seed": 5, "common_random_numbers": True} | sampling,
    }


def run(axes, path, resources=SERIAL, **sampling):
    return run_study(study_from_dict(document(axes, **sampling)), path, resources)[0]


MIXING = [0.0, 0.5, 2.0]


def test_points_share_a_stream_if_they_differ_only_in_what_is_shared():
    grid = make_grid(study_from_dict(document({"kind": ["a", "b"], "mixing": MIXING, "scale": [1.0, 2.0]})))
    streams = {}
    for point in grid.points():
        streams.setdefault(point.stream, set()).add(point.parameters["kind"])
    assert sorted(map(sorted, streams.values())) == [["a"], ["b"]]
    assert len({point.digest for point in grid.points()}) == 12


def test_ratios_of_points_that_share_random_numbers_have_no_noise(tmp_path):
    dataset = run({"scale": [1.0, 4.0], "kind": ["a", "b"]}, tmp_path / "s.zarr")
    assert (dataset["mean"].sel(scale=4.0) == 4.0 * dataset["mean"].sel(scale=1.0)).all()
    assert dataset["mean"].sel(kind="a", scale=1.0) != dataset["mean"].sel(kind="b", scale=1.0)


def test_a_point_does_not_know_who_shares_its_numbers(tmp_path):
    whole = run({"mixing": MIXING, "scale": [1.0, 3.0]}, tmp_path / "whole.zarr")
    for mixing in MIXING:
        alone = run({"mixing": [mixing]}, tmp_path / f"{mixing}.zarr")
        assert alone["mean"].item() == whole["mean"].sel(mixing=mixing, scale=1.0).item()


@pytest.mark.parametrize(
    "resources", [Resources(workers=2, pool="threads"), slow(Resources(workers=2, pool="processes"))]
)
def test_the_bits_are_those_of_the_serial_reference(tmp_path, resources):
    serial = run({"mixing": MIXING, "kind": ["a", "b"]}, tmp_path / "serial.zarr")
    other = run({"mixing": MIXING, "kind": ["a", "b"]}, tmp_path / "other.zarr", resources)
    xr.testing.assert_identical(serial.drop_attrs(), other.drop_attrs())


def test_a_study_that_grows_draws_again_only_for_what_is_new(tmp_path, monkeypatch):
    run({"mixing": MIXING[:2]}, tmp_path / "s.zarr", n_cat=20)
    asked = []
    monkeypatch.setattr("linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: spying)
    spying = replace(experiment, evaluate=lambda points, *rest: asked.extend(points) or evaluate(points, *rest))
    grown = run({"mixing": MIXING}, tmp_path / "s.zarr")
    assert len(asked) == 2 * 20 + 40
    fresh = run({"mixing": MIXING}, tmp_path / "fresh.zarr")
    xr.testing.assert_identical(grown.drop_attrs(), fresh.drop_attrs())


def test_a_point_that_raises_does_not_take_those_that_share_with_it(tmp_path, monkeypatch):
    def fail(points, *rest):
        if any(p["mixing"] == 0.5 for p in points):
            raise ValueError("no halves")
        return evaluate(points, *rest)

    whole = run({"mixing": MIXING}, tmp_path / "whole.zarr")
    monkeypatch.setattr(
        "linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: replace(experiment, evaluate=fail)
    )
    study = study_from_dict(document({"mixing": MIXING}))
    dataset, failures = run_study(study, tmp_path / "s.zarr", SERIAL)
    assert failures == {"mixing=0.5": "ValueError: no halves"}
    for mixing in (0.0, 2.0):
        assert dataset["mean"].sel(mixing=mixing) == whole["mean"].sel(mixing=mixing)


def test_results_with_and_without_do_not_mix(tmp_path):
    run({"mixing": MIXING}, tmp_path / "s.zarr")
    with pytest.raises(SweepError, match="common_random_numbers: True in the store, 'absent' in the study"):
        run({"mixing": MIXING}, tmp_path / "s.zarr", common_random_numbers=False)


def test_an_experiment_must_say_what_is_shared(coins):
    with pytest.raises(SweepError, match="the experiment 'coins' declares no parameter that leaves its random numbers"):
        study_from_dict(coins | {"sampling": {"common_random_numbers": True}})


@pytest.mark.slow
def test_the_covariance_between_points_is_that_of_their_shared_numbers(tmp_path):
    dataset = run({"mixing": MIXING}, tmp_path / "s.zarr", n_cat=600)
    covariance = dataset["mean_mc_covariance_mixing"]
    assert covariance.dims == ("mixing", "mixing_other")
    x = np.array(MIXING)
    expected = (1.0 + np.outer(x, x)) / (512 * 600)
    error = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / 600)  # of a sample covariance
    assert np.all(np.abs(covariance.values - expected) < 4.5 * error)


def test_too_few_catalogues_give_no_covariance(tmp_path):
    dataset = run({"mixing": MIXING}, tmp_path / "s.zarr", n_cat=4)
    assert "mean_mc_covariance_mixing" not in dataset
    assert dataset.attrs["common_random_numbers"] == 1


@pytest.mark.parametrize("unit", ["mas / yr", "mas yr-1", "mas", "km2 / s", "m**2 s^-2", ""])
def test_the_unit_of_a_covariance_is_the_square_as_astropy_reads_it(unit):
    assert u.Unit(squared(unit)) == u.Unit(unit) ** 2
