"""Forecasts against links of tables that have the new rows, and against all choices."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from linksweep import forecast, tie
from tests.core.tie.made import MAS, gaia, joined, stars
from tests.tiers import slow

EPOCHS = (2019.0, 2031.0)
ERROR = 0.07
SEEDS = [1, slow(2)]
RATIO = 34.0 / 66.0


@pytest.fixture(params=SEEDS)
def tables(request, tmp_path):
    """A satellite of DR3, its rows so far, and the satellite's table as DR4 may give it."""
    own = replace(stars(4, request.param, pm=30.0), radial_velocity=np.zeros(4))
    rows = replace(stars(4, request.param + 50), values=own.values, epoch=np.full(4, 2004.0))
    later = own.errors * np.array([RATIO**0.5] * 3 + [RATIO**1.5] * 2)[:, None]
    found = SimpleNamespace(folder=tmp_path, own=own, rows=rows, known={})
    found.satellite = gaia(tmp_path / "dr3.ecsv", own)
    found.scaled = gaia(tmp_path / "dr4.ecsv", replace(own, errors=later, epoch=np.full(4, 2017.5)))
    found.reference = gaia(tmp_path / "rows.ecsv", replace(rows, radial_velocity=np.zeros(4)))
    return found


def covariance(tables, satellite, sources=(), epochs=EPOCHS):
    """The formal covariance of the link whose reference has a new position of some sources at each epoch."""
    key = satellite, frozenset(sources), tuple(epochs)
    if key in tables.known:
        return tables.known[key]
    pieces, source = [tables.rows], [np.arange(4)]
    for epoch in epochs:
        one = replace(tables.own.taken(np.array(sources, dtype=np.int64)), correlations=None)
        errors = np.full((5, len(sources)), np.nan)
        errors[:2] = ERROR * MAS
        values = np.where(np.isnan(errors), np.nan, one.values)
        single = np.ones(len(sources), dtype=bool)
        pieces.append(replace(one, errors=errors, values=values, epoch=np.full(len(sources), epoch), apparent=single))
        source.append(np.array(sources, dtype=np.int64))
    joint, which = joined(*pieces), np.concatenate(source)
    joint = replace(joint, radial_velocity=np.zeros(len(joint)), correlations=np.nan_to_num(joint.correlations))
    path = gaia(tables.folder / "extended.ecsv", joint, source_id=which + 10**17)
    link = tie(satellite, path, "orientation,spin", errors="formal", epoch=2016.0, accept_misfit=True)
    tables.known[key] = link.covariance.values
    return tables.known[key]


def value(matrix, blocks, criterion):
    part = np.concatenate([np.arange(3) + 3 * ["orientation", "spin"].index(name) for name in blocks])
    chosen = matrix[np.ix_(part, part)]
    return np.sqrt(np.trace(chosen) / len(part)) if criterion == "A" else np.linalg.slogdet(chosen)[1]


@pytest.mark.parametrize("criterion", ["A", slow("D")])
@pytest.mark.parametrize("blocks", [("spin",), slow(("orientation", "spin"))])
def test_every_stage_and_choice_is_the_link_with_the_new_rows(tables, criterion, blocks):
    plan = forecast(
        tables.satellite,
        tables.reference,
        "orientation,spin",
        add=EPOCHS,
        error=ERROR,
        release="dr4",
        number=2,
        goal=blocks,
        criterion=criterion,
        epoch=2016.0,
    )
    every, scaled = range(4), tables.scaled
    close = {"rtol": 1e-5, "atol": 1e-5 if criterion == "D" else 0.0}
    stages = {
        "now": covariance(tables, tables.satellite),
        "dr4": covariance(tables, scaled),
        "all observed": covariance(tables, scaled, every),
    }
    for stage, matrix in stages.items():
        np.testing.assert_allclose(plan.error.sel(stage=stage), np.sqrt(np.diag(matrix)), rtol=1e-5, err_msg=stage)
        expected = value(matrix, blocks, criterion)
        np.testing.assert_allclose(plan.criterion.sel(stage=stage), expected, **close, err_msg=stage)
    for epoch in EPOCHS:
        matrix = covariance(tables, scaled, every, [epoch])
        found = plan.error_with_epoch.sel(new_epoch=epoch)
        np.testing.assert_allclose(found, np.sqrt(np.diag(matrix)), rtol=1e-5)
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
