"""Points that differ only in what is made of random numbers draw the same ones, and stay what they are alone."""

from dataclasses import replace

import numpy as np
import pytest

from linksweep.sweep.contract import Experiment, Output, Parameter, SweepError
from tests.sweep.opening import SERIAL, run_study, same, study_from_dict


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


def study(axes, **sampling):
    sampling = {"n_sim": 512, "n_cat": 40, "seed": 5, "common_random_numbers": True} | sampling
    document = {"title": "Mixed", "experiment": f"{__file__}:experiment", "axes": axes, "sampling": sampling}
    return study_from_dict(document)


def run(axes, path, **sampling):
    return run_study(study(axes, **sampling), path, SERIAL)[0]


MIXING = [0.0, 0.5, 2.0]


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
    same(grown, fresh)


def test_a_point_that_raises_does_not_take_those_that_share_with_it(tmp_path, monkeypatch):
    def fail(points, *rest):
        if any(p["mixing"] == 0.5 for p in points):
            raise ValueError("no halves")
        return evaluate(points, *rest)

    whole = run({"mixing": MIXING}, tmp_path / "whole.zarr")
    monkeypatch.setattr(
        "linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: replace(experiment, evaluate=fail)
    )
    dataset, failures = run_study(study({"mixing": MIXING}), tmp_path / "s.zarr", SERIAL)
    assert failures == {"mixing=0.5": "ValueError: no halves"}
    for mixing in (0.0, 2.0):
        assert dataset["mean"].sel(mixing=mixing) == whole["mean"].sel(mixing=mixing)


def test_results_with_and_without_do_not_mix(tmp_path):
    run({"mixing": MIXING}, tmp_path / "s.zarr")
    with pytest.raises(SweepError, match="common_random_numbers: True in the store, 'absent' in the study"):
        run({"mixing": MIXING}, tmp_path / "s.zarr", common_random_numbers=False)
