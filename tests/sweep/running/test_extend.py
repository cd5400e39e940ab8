"""A study that grows computes only what is new, and ends with the bits of a fresh run of the larger study."""

import random

import pytest
import xarray as xr

import linksweep
from linksweep.sweep.contract import SweepError
from tests.sweep.opening import Resources, plan_study, run_study, study_from_dict

SERIAL = Resources(pool="serial")


def run(document, path):
    return run_study(study_from_dict(document), path, SERIAL)[0]


def pending(document, path):
    return plan_study(study_from_dict(document), path)[1].pending


@pytest.mark.parametrize("chains", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_growth_of_any_kind_in_any_order_gives_the_bits_of_a_fresh_run(coins, tmp_path, chains):
    """Chains of edits: axis values, a new axis, more realisations, more catalogues, one after the other."""
    rng = random.Random(11)
    for chain in range(chains):
        document = coins | {"axes": {"coins": [5]}, "fixed": {}, "sampling": {"n_sim": 300, "n_cat": 3, "seed": 7}}
        store = tmp_path / f"{chain}.zarr"
        run(document, store)
        for _ in range(4):
            axes, sampling = dict(document["axes"]), dict(document["sampling"])
            kind = rng.choice(["value", "axis", "n_sim", "n_cat", "order"])
            if kind == "value":
                axes["coins"] = rng.sample([*axes["coins"], max(axes["coins"]) + 3], len(axes["coins"]) + 1)
            elif kind == "axis" and "metal" not in axes:
                axes = {"metal": ["tin", "gold"]} | axes  # gold is the default: these points are there already
            elif kind == "order":
                axes = dict(reversed(axes.items()))
            else:
                key = "n_cat" if kind == "n_cat" else "n_sim"
                sampling[key] += rng.randint(1, 400)
            before = pending(document, store)
            document = document | {"axes": axes, "sampling": sampling}
            grown = run(document, store)
            fresh = run(document, tmp_path / f"{chain}-{rng.random()}.zarr")
            assert before.blocks == 0
            xr.testing.assert_identical(
                grown.drop_vars("wall_time").drop_attrs(), fresh.drop_vars("wall_time").drop_attrs()
            )


def test_another_version_of_the_experiment_is_refused(coins, tmp_path, monkeypatch):
    from dataclasses import replace

    run(coins, tmp_path / "s.zarr")
    newer = replace(study_from_dict(coins), experiment=replace(study_from_dict(coins).experiment, version=2))
    with pytest.raises(SweepError, match="experiment_version: 1 in the store, 2 in the study"):
        run_study(newer, tmp_path / "s.zarr", SERIAL)


def test_points_that_are_all_there_are_not_called_incomplete(tmp_path, sweep):
    """Neither where a study asks for them of a larger store, nor where they are chosen to be shown."""
    (tmp_path / "f.py").write_text("def f(x: float):\n    return 1.0 / (x - 3.0)\n")
    whole = ("run", "f.py:f", "-o", "s.zarr", "--axis", "x=1,2,3,4")
    code, out, _ = sweep(*whole, cwd=tmp_path)
    assert (code, "INCOMPLETE: 3 of 4 points are done, 1 failed" in out) == (1, True)
    for asked in (
        ("run", "f.py:f", "-o", "s.zarr", "--axis", "x=1,2,4"),
        ("show", "s.zarr", "--at", "x=2"),
    ):
        code, out, _ = sweep(*asked, cwd=tmp_path)
        assert code == 0
        assert "INCOMPLETE" not in out
    part = linksweep.run(f"{tmp_path}/f.py:f", tmp_path / "s.zarr", axes={"x": [1.0, 2.0, 4.0]})
    assert (part.attrs["complete"], part.attrs["points"], part.attrs["points_done"]) == (1, 3, 3)
