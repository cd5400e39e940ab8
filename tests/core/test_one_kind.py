"""Catalogues whose positions, or proper motions, have no error on either side: these are not measured."""

import numpy as np
import pytest
from astropy.table import Table

from tests.core import points
from tests.core.reference import design_matrix, solve

N_OBJ = 12
RNG = np.random.default_rng(8)
RA, DEC = RNG.uniform(0.0, 2.0 * np.pi, N_OBJ), np.arcsin(RNG.uniform(-0.95, 0.95, N_OBJ))
MOTIONS = RNG.uniform(-400.0, 400.0, (2, N_OBJ))  # mas/yr
ERRORS = RNG.uniform(0.2, 2.0, (2, N_OBJ))
CORRELATION = RNG.uniform(-0.7, 0.7, N_OBJ)
NAMES = {"motions": ("pmra", "pmdec"), "positions": ("ra", "dec")}
SOLVED = {"motions": ("sigma_spin", slice(3, 6)), "positions": ("sigma_orientation", slice(0, 3))}


def point(folder, kind, correlated=False, **changes):
    first, second = NAMES[kind]
    columns = {"source_id": np.arange(N_OBJ), "ra": np.degrees(RA), "dec": np.degrees(DEC)}
    columns |= {"pmra": MOTIONS[0], "pmdec": MOTIONS[1], f"{first}_error": ERRORS[0], f"{second}_error": ERRORS[1]}
    columns |= {f"{first}_{second}_corr": CORRELATION} if correlated else {}
    Table(columns).write(folder / "one.ecsv", overwrite=True)
    file = {"catalogue": "file", "file": points.table_file(folder / "one.ecsv"), "n_obj": None}
    return points.link.defaults() | file | {"satellite_errors": "none", "reference_errors": "catalogue"} | changes


def results(*here):
    return points.results(2000, *here, seed=4)


def solution(weighting, differences=None):
    design, zero = design_matrix(RA, DEC, 0.0 * RA, 0.0 * RA)[:2, :, :3], np.zeros((2, N_OBJ))
    return solve(design, zero if differences is None else differences, ERRORS, weighting)


def sandwich(weighting, correlated):
    gain, mixed = solution(weighting).gain * ERRORS, CORRELATION if correlated else np.zeros(N_OBJ)
    covariance = np.array([[np.ones(N_OBJ), mixed], [mixed, np.ones(N_OBJ)]])
    return np.einsum("kin,ijn,ljn->kl", gain, covariance, gain)


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
@pytest.mark.parametrize("side", ["reference", "satellite"])
@pytest.mark.parametrize(("method", "correlated"), [("catalogue", False), ("projected", False), ("catalogue", True)])
def test_one_kind_of_observable_is_solved_alone(kind, weighting, side, method, correlated, tmp_path):
    other = {"reference": "satellite", "satellite": "reference"}[side]
    errors = {f"{side}_errors": "catalogue", f"{other}_errors": "none"}
    at = point(tmp_path, kind, correlated, weighting=weighting, method=method, **errors)
    assert points.link.check(at) is None
    result, n_sim = results(at), 2000
    expected = sandwich(weighting, correlated)
    (name, part), (name_beside, beside) = (SOLVED[kind], SOLVED[({*NAMES} - {kind}).pop()])
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(result["sigma_predicted"][0, part], sigma, rtol=1e-9)
    np.testing.assert_allclose(result[f"{name}_predicted"], np.sqrt(np.mean(sigma**2)), rtol=1e-9)
    assert np.all(np.abs(result["sigma"][0, part] / sigma - 1.0) < 4.5 / np.sqrt(2 * n_sim))
    scatter = np.sqrt((np.outer(sigma, sigma) ** 2 + expected**2) / n_sim)
    assert np.all(np.abs(result["covariance"][0, part, part] - expected) < 4.5 * scatter)
    assert np.all(np.isnan([result["sigma"][0, beside], result["bias"][0, beside], result["bias_mc_error"][0, beside]]))
    assert np.all(np.isnan([result[name_beside + end] for end in ("", "_predicted", "_mc_error")]))
    assert result["dof"] == 2 * N_OBJ - 3
    if weighting == "inverse-variance":
        if not correlated:
            spread = np.sqrt(2.0 * (2 * N_OBJ - 3) / n_sim)
            assert abs(result["chi2"][0] - (2 * N_OBJ - 3)) < 4.5 * spread
            assert result["chi2_mc_error"][0] == pytest.approx(spread, rel=0.01)
        assert result["condition_number"][0] == pytest.approx(solution(weighting).condition_number ** 2, rel=1e-9)


@pytest.mark.parametrize("corrections", [True, False])
@pytest.mark.parametrize("method", ["catalogue", "projected"])
def test_the_orientation_that_turns_motions_is_taken_as_known(corrections, method, tmp_path):
    """A21: an orientation of 10 arcsec turns proper motions, which biases the spin where it is left out."""
    epsilon = np.array([3000.0, -8000.0, 5000.0])  # mas
    options = {"corrections": corrections, "method": method, "epsilon": tuple(epsilon), "omega": (0.0, 0.0, 0.0)}
    options |= {"satellite_errors": "catalogue", "reference_errors": "none"}
    result = results(point(tmp_path, "motions", **options))
    turn = (np.cos(RA) * epsilon[0] + np.sin(RA) * epsilon[1]) / np.cos(DEC) * np.pi / 180.0 / 3600e3
    left_out = np.array([-MOTIONS[1] * turn, MOTIONS[0] * turn])
    bias = 0.0 if corrections else solution("inverse-variance", left_out).estimate
    np.testing.assert_allclose(result["bias_predicted"][0, 3:], bias, atol=1e-5)  # of second order in epsilon
    assert corrections or np.abs(bias).max() > 1e-3
    sigma = np.sqrt(np.diag(sandwich("inverse-variance", correlated=False)))
    np.testing.assert_allclose(result["sigma_predicted"][0, 3:], sigma, rtol=1e-9)
    assert np.all(np.abs(result["bias"][0, 3:] - bias) < 4.5 * sigma / np.sqrt(2000.0))


def test_a_glide_is_solved_for_with_motions_alone_and_refused_without(tmp_path):
    at = point(tmp_path, "motions", solve_glide=True, aberration=True)
    assert points.link.check(at) is None
    result = results(at)
    assert result["dof"] == 2 * N_OBJ - 6
    assert np.isfinite(result["glide_sigma"]).all()
    assert abs(result["chi2"][0] - (2 * N_OBJ - 6)) < 4.5 * np.sqrt(2.0 * (2 * N_OBJ - 6) / 2000.0)
    assert "not measured" in points.link.unused(point(tmp_path, "positions", solve_glide=True))["solve_glide"]


@pytest.mark.parametrize(("kind", "other"), [("motions", "positions"), ("positions", "proper motions")])
def test_what_is_not_measured_is_said(kind, other, tmp_path):
    said = [one for one in points.link.warn(point(tmp_path, kind, satellite_errors="none")) if "either side" in one]
    assert [one.partition(" have no errors")[0] for one in said] == [other]
    assert not any("either side" in one for one in points.link.warn(points.link.defaults() | {"n_obj": 20}))
