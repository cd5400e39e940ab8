"""From which release a forecast scales the errors of a table."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import linksweep
from linksweep import SweepError, forecast
from tests.core.tie.made import gaia, main, stars
from tests.tiers import examples

EPOCH = {"dr1": 2015.0, "dr2": 2015.5, "dr3": 2016.0, "dr4": 2017.5, "dr5": 2020.0}
MONTHS = {"dr1": 14, "dr2": 22, "dr3": 34, "dr4": 66, "dr5": 126}
PAIRS = list(permutations(EPOCH, 2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A reference of a later epoch, and the satellite's table at the epoch of each release and at others."""
    made = tmp_path_factory.mktemp("releases")
    gaia(made / "reference.ecsv", stars(12, 5, epoch=2008.0))
    for name, epoch in EPOCH.items():
        gaia(made / f"{name}.ecsv", stars(12, 5, epoch=epoch))
    gaia(made / "other.ecsv", stars(12, 5, epoch=1991.25))
    mixed = stars(12, 5)
    gaia(made / "mixed.ecsv", replace(mixed, epoch=np.where(np.arange(12) < 6, 2016.0, 2017.5)))
    gaia(made / "various.ecsv", replace(mixed, epoch=np.where(np.arange(12) < 6, 2016.0, 2017.3)))
    return made


def planned(folder, table, release, **options):
    return forecast(folder / f"{table}.ecsv", folder / "reference.ecsv", "orientation,spin", release=release, **options)


def errors_by_hand(folder, table, old, new):
    """The formal errors with a table whose errors were multiplied and whose epoch was moved by hand."""
    own = stars(12, 5, epoch=EPOCH.get(table, 1991.25))
    ratio = MONTHS[old] / MONTHS[new]
    errors = own.errors * np.array([ratio**0.5] * 3 + [ratio**1.5] * 2)[:, None]
    scaled = replace(own, errors=errors, epoch=own.epoch + EPOCH[new] - EPOCH[old])
    gaia(folder / "scaled.ecsv", scaled)
    return forecast(folder / "scaled.ecsv", folder / "reference.ecsv", "orientation,spin").error.values[0]


@settings(max_examples=examples(25), deadline=None)
@given(pair=st.sampled_from(PAIRS))
def test_errors_are_scaled_from_the_release_that_has_the_epoch(folder, pair):
    """A table of DR4 was scaled from DR3, which made its motions 2.7 times too good."""
    old, new = pair
    if MONTHS[new] < MONTHS[old]:
        with pytest.raises(SweepError, match=f"is that of {old}, the same or a later one"):
            planned(folder, old, new)
        plan = planned(folder, old, new, from_release=old)
    else:
        plan = planned(folder, old, new)
    np.testing.assert_allclose(plan.error.sel(stage=new), errors_by_hand(folder, old, old, new), rtol=1e-9)
    assert plan.attrs["from_release"] == old
    assert plan.attrs["epoch_of_forecast"] == EPOCH[new]
    assert any(f"scaled from {old} ({EPOCH[old]:g}) to {new}" in note for note in plan.attrs["notes"])
    assert any("Hipparcos" in note for note in plan.attrs["notes"]) == ("dr1" in pair)


@pytest.mark.parametrize("named", [None, "dr3", "dr4"])
def test_errors_are_not_scaled_twice(folder, named):
    with pytest.raises(SweepError, match="of dr4, the same or" if named != "dr3" else r"2017.5\) are those of dr4"):
        planned(folder, "dr4", "dr4", from_release=named)
    with pytest.raises(SweepError, match=r"those of dr4 .*from_release"):
        planned(folder, "dr4", "dr5", from_release="dr3")


def test_a_table_at_another_epoch_needs_the_name_of_its_release(folder):
    for table, said in (("other", "1991.25"), ("various", "2016 to 2017.3")):
        with pytest.raises(SweepError, match=rf"epochs \({said}\) are those of no release .*from_release"):
            planned(folder, table, "dr4")
    found = planned(folder, "other", "dr4", from_release="dr2").error.sel(stage="dr4")
    np.testing.assert_allclose(found, errors_by_hand(folder, "other", "dr2", "dr4"), rtol=1e-9)
    with pytest.raises(SweepError, match="epochs of dr3 and dr4"):
        planned(folder, "mixed", "dr5", from_release="dr3")
    with pytest.raises(SweepError, match="from_release = 'dr9'"):
        planned(folder, "dr3", "dr4", from_release="dr9")


def test_the_command_says_from_which_release(folder):
    tables = ["forecast", str(folder / "dr4.ecsv"), str(folder / "reference.ecsv"), "--unknowns", "orientation"]
    found = CliRunner().invoke(main, [*tables, "--release", "dr5"])
    assert found.exit_code == 0, found.output
    assert "errors scaled from dr4 (2017.5) to dr5: positions x 0.724, motions x 0.379" in found.output
    wrong = CliRunner().invoke(main, [*tables, "--release", "dr5", "--from-release", "dr3"])
    assert wrong.exit_code == 2
    assert "from_release" in wrong.output


def test_a_study_scales_from_the_same_release(folder):
    tables = {name: str(folder / f"{one}.ecsv") for name, one in (("satellite", "dr4"), ("reference", "reference"))}
    fixed = tables | {"accept_misfit": True, "release": "dr5"}  # the stars do not move between the epochs
    study = {"experiment": "linksweep.sweep.tie.experiment:tie", "sampling": {"n_sim": 2}}
    predicted = linksweep.run(study | {"fixed": fixed}, folder / "s.zarr", pool="serial").sigma_predicted.values[
        ..., :6
    ]
    np.testing.assert_allclose(predicted.ravel(), errors_by_hand(folder, "dr4", "dr4", "dr5"), rtol=1e-9)
    for changes, words in (({"from_release": "dr3"}, "are those of dr4"), ({"release": "dr3"}, "a later one")):
        with pytest.raises(SweepError, match=words):
            linksweep.run(study | {"fixed": fixed | changes}, folder / "t.zarr", pool="serial")
