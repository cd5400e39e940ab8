"""Points that differ only in what is made of random numbers draw the same ones, and stay what they are alone."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from tests.sweep.opening import Resources, make_grid, run_study, study_from_dict

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


def test_a_point_does_not_know_who_shares_its_numbers(tmp_path):
    whole = run({"mixing": MIXING, "scale": [1.0, 3.0]}, tmp_path / "whole.zarr")
    for mixing in MIXING:
        alone = run({"mixing": [mixing]}, tmp_path / f"{mixing}.zarr")
        assert alone["mean"].item() == whole["mean"].sel(mixing=mixing, scale=1.0).item()


def test_a_study_that_grows_draws_again_only_for_what_is_new(tmp_path, monkeypatch):
    run({"mixing": MIXING[:2]}, tmp_path / "s.zarr", n_cat=20)
    asked = []
    monkeypatch.setattr("linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: spying)
    spying = replace(experiment, evaluate=lambda points, *rest: asked.extend(points) or evaluate(points, *rest))
    grown = run({"mixing": MIXING}, tmp_path / "s.zarr")
    assert len(asked) == 2 * 20 + 40
    fresh = run({"mixing": MIXING}, tmp_path / "fresh.zarr")
    xr.testing.assert_identical(grown.drop_vars("wall_time").drop_attrs(), fresh.drop_vars("wall_time").drop_attrs())


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


@pytest.mark.slow
def test_the_covariance_between_points_is_that_of_their_shared_numbers(tmp_path):
    dataset = run({"mixing": MIXING}, tmp_path / "s.zarr", n_cat=600)
    covariance = dataset["mean_mc_covariance_mixing"]
    assert covariance.dims == ("mixing", "mixing_other")
    assert covariance.attrs["units"] == "m2"
    x = np.array(MIXING)
    expected = (1.0 + np.outer(x, x)) / (512 * 600)
    error = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / 600)  # of a sample covariance
    assert np.all(np.abs(covariance.values - expected) < 4.5 * error)
