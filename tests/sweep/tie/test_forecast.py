"""Forecasts against links of tables that have the new rows, against all choices, and with errors scaled by hand."""

from dataclasses import replace
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from linksweep import SweepError, forecast, tie
from linksweep.core.tie.astrometry import with_variance
from tests.core.tie.made import MAS, POSITION, gaia, gaia_table, joined, noise, only, stars
from tests.sweep.tie.test_study import written
from tests.tiers import examples, slow

EPOCH = {"dr1": 2015.0, "dr2": 2015.5, "dr3": 2016.0, "dr4": 2017.5, "dr5": 2020.0}
MONTHS = {"dr1": 14, "dr2": 22, "dr3": 34, "dr4": 66, "dr5": 126}
EPOCHS = (2019.0, 2031.0)
ERROR = 0.07


def scaled(ours, old, new):
    """The table of a release as a later one may give it: positions by T^-1/2, motions by T^-3/2, another epoch."""
    ratio = MONTHS[old] / MONTHS[new]
    errors = ours.errors * np.array([ratio**0.5] * 3 + [ratio**1.5] * 2)[:, None]
    return replace(ours, errors=errors, epoch=ours.epoch + EPOCH[new] - EPOCH[old])


def seen(ours, rows):
    return ours.values + noise(np.random.default_rng(1), rows) / [np.cos(ours.values[1]), *np.ones((4, len(ours)))]


@pytest.fixture(params=[1, slow(2)])
def tables(request, tmp_path):
    ours = replace(stars(4, request.param, pm=1e-3, parallax=1e-3), radial_velocity=np.zeros(4))
    rows = replace(stars(4, request.param + 50, epoch=2004.0), radial_velocity=np.zeros(4))
    rows = replace(rows, values=seen(ours, rows))
    paths = gaia(tmp_path / "dr3.fits", ours), gaia(tmp_path / "rows.fits", rows)
    later = gaia(tmp_path / "dr4.fits", scaled(ours, "dr3", "dr4"))
    return SimpleNamespace(folder=tmp_path, ours=ours, rows=rows, known={}, paths=paths, scaled=later, options={})


def covariance(tables, satellite, sources=(), epochs=EPOCHS):
    key = satellite, frozenset(sources), tuple(epochs)
    if key in tables.known:
        return tables.known[key]
    which = np.array([*range(4), *(len(epochs) * list(sources))], dtype=np.int64)
    new = tables.ours.taken(which[4:])
    changes = {"errors": np.full((5, len(new)), ERROR * MAS), "correlations": np.zeros((10, len(new)))}
    new = only(new, POSITION, epoch=np.repeat(epochs, len(sources)), **changes)
    joint = joined(tables.rows, replace(new, values=seen(new, new)))
    joint = replace(joint, radial_velocity=np.zeros(len(joint)))
    path = gaia(tables.folder / "extended.fits", joint, source_id=which + 10**17)
    how = {"epoch": 2016.0, "accept_misfit": True, **tables.options}
    link = tie(satellite, path, "orientation,spin", errors="formal", **how)
    tables.known[key] = link.covariance.values
    return tables.known[key]


def value(matrix, blocks, criterion):
    part = np.concatenate([np.arange(3) + 3 * ["orientation", "spin"].index(name) for name in blocks])
    chosen = matrix[np.ix_(part, part)]
    return np.sqrt(np.trace(chosen) / len(part)) if criterion == "A" else np.linalg.slogdet(chosen)[1]


@pytest.mark.parametrize("criterion", ["A", slow("D")])
@pytest.mark.parametrize("blocks", [("spin",), slow(("orientation", "spin"))])
@pytest.mark.parametrize("weights", ["covariance", *map(slow, ("variance", "equal"))])
@pytest.mark.parametrize("jitter", ["five-parameter=0.1:0.02,all=0.3", slow("")])
def test_every_stage_and_choice_is_the_link_with_the_new_rows(tables, criterion, blocks, weights, jitter):
    tables.options = {"weights": weights, "jitter": jitter}
    options = {"add": EPOCHS, "error": ERROR, "release": "dr4", "number": 2, "goal": blocks, "criterion": criterion}
    plan = forecast(*tables.paths, "orientation,spin", epoch=2016.0, **tables.options, **options)
    every, scaled = range(4), tables.scaled
    close = {"rtol": 1e-5, "atol": 1e-5 if criterion == "D" else 0.0}
    stages = {"now": covariance(tables, tables.paths[0]), "dr4": covariance(tables, scaled)}
    stages["all observed"] = covariance(tables, scaled, every)
    for stage, matrix in stages.items():
        np.testing.assert_allclose(plan.error.sel(stage=stage), np.sqrt(np.diag(matrix)), rtol=1e-5, err_msg=stage)
        expected = value(matrix, blocks, criterion)
        np.testing.assert_allclose(plan.criterion.sel(stage=stage), expected, **close, err_msg=stage)
    for epoch in EPOCHS:
        expected = np.sqrt(np.diag(covariance(tables, scaled, every, [epoch])))
        np.testing.assert_allclose(plan.error_with_epoch.sel(new_epoch=epoch), expected, rtol=1e-5)
    alone = np.array([value(covariance(tables, scaled, [s]), blocks, criterion) for s in every])
    np.testing.assert_allclose(plan.criterion_alone, alone, **close)
    np.testing.assert_array_equal(plan["rank"], [1 + int(np.sum(alone < one)) for one in alone])
    chosen = []
    for step, name in enumerate(plan.step_source.values):
        if step:
            left = [s for s in every if s not in chosen]
            best = min(left, key=lambda s: value(covariance(tables, scaled, [*chosen, s]), blocks, criterion))
            assert str(name) == str(plan.source.values[best])
            chosen.append(best)
        matrix = covariance(tables, scaled, chosen)
        np.testing.assert_allclose(plan.step_error.values[step], np.sqrt(np.diag(matrix)), rtol=1e-5)
        np.testing.assert_allclose(plan.step_criterion.values[step], value(matrix, blocks, criterion), **close)


def resting(epoch):
    return stars(12, 5, pm=1e-3, parallax=1e-3, epoch=epoch)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("releases")
    reference = resting(2008.0)
    gaia(made / "reference.fits", replace(reference, values=seen(reference, reference)))
    for name, epoch in EPOCH.items():
        gaia(made / f"{name}.fits", resting(epoch))
    gaia(made / "other.fits", resting(1991.25))
    for name, epoch in (("mixed", 2017.5), ("various", 2017.3)):
        gaia(made / f"{name}.fits", replace(resting(2016.0), epoch=np.repeat([2016.0, epoch], 6)))
    return made


def planned(folder, table, release, **options):
    return forecast(folder / f"{table}.fits", folder / "reference.fits", "orientation,spin", release=release, **options)


def errors_by_hand(folder, table, old, new):
    gaia(folder / "scaled.fits", scaled(resting(EPOCH.get(table, 1991.25)), old, new))
    return forecast(folder / "scaled.fits", folder / "reference.fits", "orientation,spin").error.values[0]


@settings(max_examples=examples(25, quick=2), deadline=None)
@given(pair=st.sampled_from(list(permutations(EPOCH, 2))))
def test_errors_are_scaled_from_the_release_that_has_the_epoch(folder, pair):
    old, new = pair
    if backwards := MONTHS[new] < MONTHS[old]:
        with pytest.raises(SweepError, match=f"is that of {old}, the same or a later one"):
            planned(folder, old, new)
    plan = planned(folder, old, new, from_release=old if backwards else None)
    np.testing.assert_allclose(plan.error.sel(stage=new), errors_by_hand(folder, old, old, new), rtol=1e-9)
    now = planned(folder, old, "table", epoch=EPOCH[new])  # at the epoch of the others
    np.testing.assert_allclose(plan.error.sel(stage="now"), now.error.sel(stage="now"), rtol=1e-9)
    assert [plan.attrs[name] for name in ("from_release", "epoch", "epoch_of_forecast")] == [old, *[EPOCH[new]] * 2]
    assert any(f"scaled from {old} ({EPOCH[old]:g}) to {new}" in note for note in plan.attrs["notes"])
    assert any("Hipparcos" in note for note in plan.attrs["notes"]) == ("dr1" in pair)


def test_errors_are_not_scaled_twice_and_a_table_at_another_epoch_needs_the_name_of_its_release(folder):
    for named, new, said in (
        *((None, "dr4", "of dr4, the same or"), ("dr4", "dr4", "of dr4, the same or")),
        *(("dr3", "dr4", r"2017.5\) are those of dr4"), ("dr3", "dr5", r"those of dr4 .*from_release")),
        *(("dr9", "dr5", "from_release = 'dr9'"), ("dr3", "table", "from_release dr3, but no release to scale")),
    ):
        with pytest.raises(SweepError, match=said):
            planned(folder, "dr4", new, from_release=named)
    for table, said in (("other", "1991.25"), ("various", "2016 to 2017.3")):
        with pytest.raises(SweepError, match=rf"epochs \({said}\) are those of no release .*from_release"):
            planned(folder, table, "dr4")
    result = planned(folder, "other", "dr4", from_release="dr2").error.sel(stage="dr4")
    np.testing.assert_allclose(result, errors_by_hand(folder, "other", "dr2", "dr4"), rtol=1e-9)
    how = {"release": "dr4", "from_release": "dr2", "epoch": 2011.0}
    study = in_a_study(folder, folder / "other.fits", folder / "reference.fits", **how)
    np.testing.assert_allclose(study, planned(folder, "other", **how).error.sel(stage="dr4"), rtol=1e-9)
    with pytest.raises(SweepError, match="epochs of dr3 and dr4"):
        planned(folder, "mixed", "dr5", from_release="dr3")


def in_a_study(folder, satellite, reference, **fixed):
    result = written(folder, satellite=str(satellite), reference=str(reference), **fixed)
    return result.sigma_predicted.values.ravel()[:6]


@pytest.mark.parametrize("jitter", [slow(""), slow("position=0.2:0.02")])
def test_new_positions_of_quasars_are_mean_ones_that_hold_at_any_epoch(tmp_path, folder, jitter):
    quasars = replace(stars(12, 5, pm=0.0, parallax=0.0), radial_velocity=np.zeros(12))
    ours = replace(quasars, values=seen(quasars, quasars))
    tables, plan = (gaia(tmp_path / "own.ecsv", ours), tmp_path / "0.ecsv"), {"add": [2030], "error": ERROR}
    new = only(quasars, POSITION, errors=np.full((5, 12), ERROR * MAS), correlations=np.zeros((10, 12)))
    exact = replace(quasars, errors=quasars.errors * np.array([1.0, 1.0, np.nan, 1e-6, 1e-6])[:, None])
    exact = with_variance(exact, ((np.array([0.2, 0.2, 0.0, 0.02, 0.02]) * bool(jitter) * MAS) ** 2)[:, None])
    rows, how, links = only(quasars, POSITION), {"extragalactic": "reference", "jitter": jitter}, []
    for k, made in enumerate(([rows], [new], [rows, new], [exact, new])):
        table = gaia_table(replace(joined(*made), radial_velocity=np.zeros(12 * len(made))))
        table["source_id"] = np.arange(len(table)) % 12 + 10**17
        table.remove_column("ref_epoch")
        table.write(tmp_path / f"{k}.ecsv")
        links.append(tie(tables[0], tmp_path / f"{k}.ecsv", errors="formal", **how))  # of orientation and spin
    for name in ("estimate", "error", "chi2", "dof"):
        np.testing.assert_allclose(links[2][name], links[3][name], rtol=1e-5, atol=1e-7, err_msg=name)
    north = (quasars.values[1] - ours.values[1]) / MAS  # neither moved nor displaced
    np.testing.assert_allclose(links[0].difference.sel(observable="dec"), north, atol=1e-6)
    assert "say --extragalactic" in str(tie(*tables, reference_epoch=2015.5, accept_misfit=True).attrs["notes"])
    moving = only(stars(12, 5), POSITION[:, None] | (np.arange(12) > 7))  # some without motions, where none is exact
    moving = tie(gaia(tmp_path / "moving.ecsv", moving), tables[1], accept_misfit=True, **how)
    assert "(are these quasars?)" in moving.attrs["misfit"]
    np.testing.assert_allclose(forecast(*tables, **plan, **how).error[1], links[2].error)
    np.testing.assert_allclose(in_a_study(tmp_path, *tables, n_new=12, new_error=ERROR, **how), links[2].error)
    if not jitter:
        for epoch in (2016.0, 2010.0):  # the spin moves quasars of the satellite's frame in the other
            one, other = tie(*tables, epoch=epoch, **how), tie(*tables[::-1], epoch=epoch, extragalactic="satellite")
            np.testing.assert_allclose([-other.estimate, other.error], [one.estimate, one.error], rtol=1e-5)
        plan = forecast(tables[0], "zero-motion", "orientation,spin", **plan)
        np.testing.assert_allclose(plan.error[1], links[1].error)
        rest = gaia(tmp_path / "rest.ecsv", only(quasars, ~POSITION, errors=np.zeros((5, 12))))
        both = (tie(tables[0], one, "spin,parallax", zero_errors="exact") for one in (rest, "zero-motion"))
        np.testing.assert_array_equal(*([link.estimate, link.error] for link in both))
        both = folder / "dr3.fits", gaia(tmp_path / "few.fits", resting(2008.0).taken(np.arange(6)))
        study = in_a_study(tmp_path, *both, candidates="all", n_new=12, new_epoch=2036.0, new_error=ERROR)
        plan = forecast(*both, "orientation,spin", add=[2036.0], error=ERROR, all_sources=True)
        np.testing.assert_allclose(study, plan.error[1], rtol=1e-6)
        rows = gaia(tmp_path / "rows.ecsv", only(resting(2016.0), POSITION))  # mean: of the reference alone
        link = tie(both[0], rows, "orientation,hip:orientation", missions={"hip": rows}, positions="mean")
        kinds = {*zip(link.row_table.values.tolist(), link.row_kind.values.tolist(), strict=True)}
        assert kinds == {("reference", "position"), ("hip", "single epoch")}


def test_new_positions_are_of_the_kind_that_the_reference_is_marked_to_be(folder):
    marked = gaia_table(only(resting(2008.0), POSITION))
    marked.meta["positions"] = "mean"
    marked.write(folder / "marked.ecsv")
    tables, how = (folder / "dr3.fits", folder / "marked.ecsv"), {"unknowns": "orientation", "add": [2030.2]}
    plans = (forecast(*tables, positions=positions, **how) for positions in ("table", "mean", "single-epoch"))
    marked, mean, single = (plan.error.values[1] for plan in plans)
    assert np.all((marked == mean) & (single > mean))
    exact = replace(ours := resting(2016.0), errors=ours.errors * np.where(np.isin(np.arange(12), [3, 8]), 1.0, 100.0))
    tables = gaia(folder / "own.fits", exact), gaia(folder / "rows.fits", only(ours, POSITION))  # without the spin
    plan = forecast(*tables, "orientation,spin", epoch=2016.0, add=[2036.0], error=0.05, number=20)
    assert "only 12 sources to choose" in plan.attrs["notes"]
    assert {*plan.step_source.values[1:3]} == {f"{10**17 + 3}", f"{10**17 + 8}"}  # also before they determine it


@pytest.mark.slow
def test_estimated_noise_is_in_new_rows_and_is_not_scaled_to_a_release(tmp_path):
    ours, rng = replace(resting(2016.0), correlations=np.zeros((10, 12))), np.random.default_rng(4)
    rows = only(joined(*(replace(ours, epoch=ours.epoch - years) for years in (3.0, 8.0, 14.0))), POSITION)
    rows = replace(rows, values=rows.values + 5.0 * noise(rng, rows), radial_velocity=np.zeros(36))
    ours = replace(ours, values=ours.values + 5.0 * noise(rng, ours))
    source = 10**17 + np.arange(48) % 12
    tables = gaia(tmp_path / "own.fits", ours), gaia(tmp_path / "rows.fits", rows, source_id=source[:36])
    link = tie(*tables, "orientation,spin", jitter="estimate", accept_misfit=True)
    size = dict(zip(link.noise.values.tolist(), link.noise_size.values * MAS, strict=True))

    def noisy(table, kind):
        sizes = [size.get(f"{kind}:{name}", 0.0) for name in ("position", "position", "parallax", "motion", "motion")]
        return replace(table, errors=np.hypot(table.errors, np.array(sizes)[:, None]))

    new = only(ours, POSITION, errors=np.full((5, 12), ERROR * MAS), epoch=np.full(12, 2031.0))
    rows = noisy(replace(joined(rows, new), radial_velocity=np.zeros(48)), "single epoch")
    later = gaia(tmp_path / "later.fits", noisy(scaled(ours, "dr3", "dr5"), "satellite"))
    rows = gaia(tmp_path / "all.fits", rows, source_id=source)
    expected = tie(later, rows, "orientation,spin", errors="formal", accept_misfit=True).error
    error = in_a_study(tmp_path, *tables, release="dr5", jitter="estimate", n_new=12, new_epoch=2031.0, new_error=ERROR)
    np.testing.assert_allclose(error, expected, rtol=1e-5)
