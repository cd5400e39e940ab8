"""Rows of 7 and 9 parameters: as they are read, propagated and eliminated, against full matrices and plain vectors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

import linksweep
from linksweep.core.frames import DEGREE, MAS, triad
from linksweep.core.tie.astrometry import by_errors, propagated
from linksweep.sweep.tables.columns import ALL_PAIRS
from linksweep.sweep.tie.tables import TableOptions, read_table
from tests.core.tie.made import NAMES, gaia, noise, only, seen_by_satellite, stars
from tests.sweep.tie.test_against_least_squares import EPSILON, KINDS, OMEGA, compare
from tests.tiers import slow

NINE = (*NAMES, "accel_ra", "accel_dec", "deriv_accel_ra", "deriv_accel_dec")
TIE = "linksweep.sweep.tie.experiment:tie"


def drawn(n, seed, models=(5, 7, 9), epoch=2017.5):
    """Return five parameters in the reference's frame, accelerations (4, n), covariances (n, 9, 9) and sizes."""
    rng = np.random.default_rng(seed)
    made = replace(stars(n, seed, pm=20.0, epoch=epoch), radial_velocity=np.zeros(n))
    sizes = np.array(models)[np.arange(n) % len(models)]
    half = rng.normal(size=(n, 9, 14))
    wanted = np.concatenate([made.errors, rng.uniform(0.02, 0.05, (4, n)) * MAS])
    covariance = np.einsum("ijn,in,jn->nij", by_errors(half @ half.swapaxes(1, 2))[1], wanted, wanted)
    for one, size in zip(covariance, sizes, strict=True):
        one[size:] = one[:, size:] = 0.0
    accelerations = rng.normal(0.0, 2.0 * MAS, (4, n)) * (np.arange(5, 9)[:, None] < sizes)
    accelerations[2:] *= 0.1
    return made, accelerations, covariance, sizes


def satellite_table(path, made, accelerations, covariance, sizes, form="named", **changes):
    sigma, correlation = by_errors(covariance)
    values = np.concatenate([made.values, accelerations])
    table = Table({"source_id": np.arange(len(made)) + 10**17, "ref_epoch": made.epoch})
    for k, name in enumerate(NINE):
        blank = sizes <= k
        table[name] = MaskedColumn(values[k] / (DEGREE if k < 2 else MAS), mask=blank)
        table[f"{name}_error"] = MaskedColumn(sigma[k] / MAS, mask=blank)
    if form == "named":
        for i, j in ALL_PAIRS:
            table[f"{NINE[i]}_{NINE[j]}_corr"] = MaskedColumn(correlation[i, j], mask=sizes <= j)
    else:
        vectors = np.full((len(made), 98), np.nan)
        vectors[:, :36] = np.array([correlation[i, j] for j in range(1, 9) for i in range(j)]).T
        for row, size in zip(vectors, sizes, strict=True):
            row[size * (size - 1) // 2 :] = np.nan
        lists = [f"[{', '.join(f'{x!r}' for x in row[np.isfinite(row)].tolist())}]" for row in vectors]
        table["corr_vec"] = vectors if form == "padded" else lists
    for name, column in changes.items():
        table[name] = column
    table.write(path, overwrite=True)
    return path


@pytest.mark.parametrize(("form", "ending"), [("named", "ecsv"), ("padded", "fits"), ("text", "csv")])
def test_rows_of_each_model_are_read(tmp_path, form, ending):
    made, accelerations, covariance, sizes = drawn(9, 1)
    read = read_table(satellite_table(tmp_path / f"dr4.{ending}", made, accelerations, covariance, sizes, form))
    np.testing.assert_allclose(read.astrometry.further[0, :4], accelerations, rtol=1e-12)
    result = read.astrometry.covariance()[:, :9, :9]
    np.testing.assert_allclose(result, covariance, rtol=1e-9, atol=1e-12 * covariance.max())
    assert any("3 of 5, 3 of 7, 3 of 9" in note for note in read.notes)
    if form == "text":  # a missing number has its place
        before, _, rest = (tmp_path / "dr4.csv").read_text().partition("[")
        for word, said in {"null": "no corr_vec .write 0 for none. in row 1$", "np.float32(1)": "'corr_vec': "}.items():
            (tmp_path / "dr4.csv").write_text(f"{before}[{word},{rest.partition(',')[2]}")
            with pytest.raises(linksweep.SweepError, match=said):
                read_table(tmp_path / "dr4.csv")
    if form == "named":  # a unit is converted, and a wrong one noted
        table, units = Table.read(tmp_path / f"dr4.{ending}"), {}
        for column in ("accel_ra", "accel_dec", "accel_ra_error", "accel_dec_error"):
            table[column], units[column] = 1000.0 * table[column], "uas/yr2"
        table.write(tmp_path / "wrong.ecsv")
        assert sum("is its unit right" in note for note in read_table(tmp_path / "wrong.ecsv").notes) == 2
        result = read_table(tmp_path / "wrong.ecsv", TableOptions(units=units)).astrometry
        np.testing.assert_allclose(result.further, read.astrometry.further, rtol=1e-12)


def path(star, accelerations, years):
    """Return five parameters after some years: uniform motion, and a polynomial in the tangent plane at the start."""
    moved = propagated(star.values, None, star.epoch, star.epoch + years)
    east, north, _ = triad(*star.values[:2])
    shift = years**2 / 2.0 * accelerations[:2] + years**3 / 6.0 * accelerations[2:]
    place = triad(*moved[:2]).r + shift[0] * east + shift[1] * north
    faster = years * accelerations[:2] + years**2 / 2.0 * accelerations[2:]
    position = np.arctan2(place[1], place[0]), np.arctan2(place[2], np.hypot(*place[:2]))
    return np.array([*position, moved[2], *(moved[3:] + faster)])


def made_link(folder, seed, n=12, epoch=2017.5, change=None, **options):
    rng = np.random.default_rng(seed)
    made, accelerations, covariance, sizes = drawn(n, seed, epoch=epoch)
    ours = replace(made, values=seen_by_satellite(made, EPSILON + OMEGA * (epoch - 2016.0), OMEGA))
    errors = np.array([rng.multivariate_normal(np.zeros(9), one, method="eigh") for one in covariance]).T
    source, epochs = np.repeat(np.arange(n), 3), rng.uniform(2003.0, 2024.0, 3 * n)
    rows = replace(made.taken(source), radial_velocity=np.zeros(3 * n), epoch=epochs)
    truth = path(made.taken(source), accelerations[:, source], epochs - epoch)
    rows = replace(rows, values=truth + noise(rng, rows))
    rows = only(rows, (np.arange(5)[:, None] < 2) | (np.arange(3 * n) % 3 == 0))
    shift = errors[:5] / np.array([np.cos(ours.values[1]), *np.ones((4, n))])
    ours, accelerations = replace(ours, values=ours.values + shift), accelerations + errors[5:]
    if change is not None:
        accelerations = change(accelerations)
    satellite = satellite_table(folder / "satellite.fits", ours, accelerations, covariance, sizes)
    reference = gaia(folder / "reference.fits", rows, source_id=source + 10**17)
    options = {"epoch": 2016.0, "positions": "mean", "accept_misfit": True} | options
    link = linksweep.tie(satellite, reference, "orientation,spin", **options)
    tables = {"ours": ours, "rows": rows, "source": source, "covariance": covariance}
    return link, SimpleNamespace(**tables, accelerations=accelerations, sizes=sizes)


@pytest.mark.parametrize("seed", [1, *map(slow, (2, 3))])
def test_a_link_is_that_of_full_matrices(tmp_path, seed):
    link, tables = made_link(tmp_path, seed, errors=KINDS, by="position:0.05")  # where the bent paths are
    compare(link, tables, "covariance")
    assert not link.attrs["misfit"]
    np.testing.assert_allclose(link.estimate, np.concatenate([EPSILON, OMEGA]) / MAS, atol=0.3)


def test_the_mean_motions_of_dr3_are_those_of_its_polynomials(tmp_path):
    made, accelerations, covariance, sizes = drawn(9, 6, epoch=2016.0)
    made = replace(made, values=made.values * np.array([1.0, 0.5, 1.0, 1.0, 1.0])[:, None])
    made = replace(made, epoch=made.epoch - 2.2 * (sizes == 5))  # straight paths, of no release
    kinds = np.array([f"Acceleration{size}" for size in sizes])
    table = tmp_path / "nss.fits", made, accelerations, covariance, sizes
    path = satellite_table(*table, nss_solution_type=kinds)
    span, a, b, t = 517.5 / 365.25, accelerations[:2], accelerations[2:], 3.0
    # the documentation of DR3, Eq. 7.5
    shift = a * (t**2 - span**2 / 3.0) / 2.0 + b * (t**2 - span**2) * t / 6.0
    there = propagated(made.values, None, made.epoch, made.epoch + t)
    there[:2] += shift / np.array([np.cos(there[1]), np.ones(9)])
    there[3:] += a * t + b * (t**2 - span**2 / 3.0) / 2.0
    rows = replace(made, values=there, epoch=made.epoch + t, radial_velocity=np.zeros(9))
    reference = gaia(tmp_path / "rows.fits", rows)
    link = linksweep.tie(path, reference, "orientation,spin")
    np.testing.assert_allclose(link.estimate, 0.0, atol=1e-4)
    assert any("averages, as in DR3" in note for note in link.attrs["notes"])
    ours = linksweep.tie(path, reference, "orientation,spin", accelerations="at-epoch", accept_misfit=True)
    assert np.abs(ours.estimate).max() > 0.01


def test_accelerations_of_a_reference_leave_its_five_parameters(tmp_path):
    made, accelerations, covariance, sizes = drawn(9, 9)
    ours = gaia(tmp_path / "own.fits", replace(made, values=seen_by_satellite(made, EPSILON, OMEGA)))
    reference = satellite_table(tmp_path / "nss.fits", made, accelerations, covariance, sizes)
    link = linksweep.tie(ours, reference, "orientation,spin")
    assert any("accelerations in nss.fits are not compared" in note for note in link.attrs["notes"])
    table = Table.read(reference)
    table.remove_columns([name for name in table.colnames if "accel" in name])
    table.write(tmp_path / "five.fits")
    same = linksweep.tie(ours, tmp_path / "five.fits", "orientation,spin")
    np.testing.assert_array_equal(link.estimate, same.estimate)


@pytest.mark.slow
def test_an_accelerated_satellite_in_a_forecast_and_in_draws(tmp_path):
    _, made = made_link(tmp_path, 11)
    tables, options = (tmp_path / "satellite.fits", tmp_path / "reference.fits"), {"positions": "mean"}
    plan = linksweep.forecast(*tables, "orientation,spin", add=[2030.0], release="dr5", **options)
    assert np.all(np.diff(plan.error.sel(unknown="omega_x")) < 0.0)
    powers = np.array([*[0.5] * 3, 1.5, 1.5, 2.5, 2.5, 3.5, 3.5])  # from DR4, errors by T^-1/2 and so on
    shrunk = (66.0 / 126.0) ** powers
    dr5 = replace(made.ours, epoch=np.full(12, 2020.0)), made.accelerations, made.covariance * np.outer(shrunk, shrunk)
    by_hand = satellite_table(tmp_path / "dr5.fits", *dr5, made.sizes)
    result = linksweep.forecast(by_hand, tables[1], "orientation,spin", **options).error[0]
    np.testing.assert_allclose(plan.error.sel(stage="dr5"), result, rtol=1e-9)
    fixed = {"satellite": str(tables[0]), "reference": str(tables[1])} | options
    study = {"experiment": TIE, "fixed": fixed, "axes": {"correlations": [True, False]}, "sampling": {"n_sim": 300}}
    drawn_links = linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    np.testing.assert_allclose(drawn_links.sigma_spin / drawn_links.sigma_spin_predicted, 1.0, atol=0.14)
