"""Links with epoch astrometry in Gaia's formats, against least squares of every parameter and ESA's gaiasupdate."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from astropy.table import Table, vstack
from hypothesis import Phase, given, settings, strategies as st

import linksweep
from linksweep.core.frames import DEGREE, MAS
from linksweep.core.tie.astrometry import PAIRS, bends, by_errors, parallax_factors, propagated
from linksweep.sweep.tie.tables import built_in
from tests.core.tie.made import POSITION, gaia_table, only, seen_by_satellite, stars
from tests.sweep.tie.test_against_least_squares import turned
from tests.tiers import examples, few, slow

EPSILON, OMEGA = np.array([0.4, -0.3, 0.5]) * MAS, np.array([-0.05, 0.06, 0.04]) * MAS
ARRAYS = ("obs_time_tcb", "scan_pos_angle", "centroid_pos_al", "centroid_pos_error_al", "used_by_agis_al")
EPOCH = 2017.5
NODE, INCLINATION, PERIASTRON = np.radians([50.0, 60.0, 110.0])
(CW, CN, CI), (SW, SN, _) = (f([PERIASTRON, NODE, INCLINATION]) for f in (np.cos, np.sin))
ABFG = [CW * CN - SW * SN * CI, CW * SN + SW * CN * CI, -SW * CN - CW * SN * CI, -SW * SN + CW * CN * CI]
ORBIT = np.array([2.3, 0.3, 0.4, *ABFG])  # period, eccentricity, periastron, and elements of a semi-axis of 1
BENDS = {"5": [], "7": [0, 1], "9": [0, 1, 2, 3], "orbit": [4]}  # parameters of each path beyond the five
PATHS = st.lists(st.sampled_from([*BENDS]), min_size=5, max_size=7)
UNITS = dict(zip(ARRAYS[:4], ("ns", "deg", "mas", "mas"), strict=True)) | {"obs_time_bary_corr": "ns", "ra0": "deg"}


def drawn(seed, models, n_transits=24, bend=1.0, excess=0.0, ccds=9):
    """Return tables of stars on the paths of ``models``, and derivatives of each observation by eleven parameters."""
    rng, n = np.random.default_rng(seed), len(models)
    made = replace(stars(n, seed, pm=40.0, parallax=8.0, epoch=EPOCH), radial_velocity=np.zeros(n))
    further = np.zeros((n, 5))
    for one, model in zip(further, models, strict=True):
        used = BENDS[model]
        one[used] = bend * np.array([0.4, -0.5, 0.1, 0.15, 1.5])[used] * MAS * rng.choice([-1.0, 1.0], len(used))
    orbits = np.where(np.array(models) == "orbit", ORBIT[:, None], 0.0)
    seen, names = seen_by_satellite(made, EPSILON, OMEGA), 10**17 + 7 * np.arange(n)
    parts, designs, values, errors, fitted = [], [], [], [], []
    for s in range(n):
        years = np.sort(rng.uniform(2014.7, 2020.0, n_transits)) - EPOCH
        angle = rng.uniform(-180.0, 180.0, n_transits)
        east, north = parallax_factors(*np.repeat(seen[:2, [s]], n_transits, axis=1), EPOCH + years)
        factor = (east * np.sin(angle * DEGREE) + north * np.cos(angle * DEGREE)).astype(np.float32)
        times = (years[:, None] + EPOCH - 2010.0) * 3.15576e16 + 4.86e9 * np.arange(ccds)
        delay = (rng.uniform(-4.8e11, 4.8e11, n_transits)).astype(np.float32)
        angles = angle[:, None] + 1e-4 * np.arange(ccds)
        colour = rng.normal(0.0, 0.3, n_transits).astype(np.float32)
        t = (times.astype(np.int64) + np.float64(delay[:, None])) / 3.15576e16 - 7.5
        sine, cosine = np.sin(angles * DEGREE), np.cos(angles * DEGREE)
        flat = bends(t.ravel(), np.repeat(orbits[:, [s]], t.size, axis=1))[:, :2]
        bent = np.moveaxis(flat, 0, 2).reshape(2, 5, *t.shape)
        of_transit = np.repeat([factor, -1e3 * colour], ccds, axis=1).reshape(2, *t.shape)
        along = sine * bent[0] + cosine * bent[1]
        design = np.array([sine, cosine, of_transit[0], sine * t, cosine * t, *along, of_transit[1]])
        error = rng.uniform(0.1, 0.5, t.shape).astype(np.float32).astype(np.float64)
        size = np.hypot(error, excess)
        truth = np.array([0.0, 0.0, *seen[2:, s], *further[s], 0.0]) / MAS
        w = np.einsum("kij,k->ij", design, truth) + size * rng.normal(size=t.shape)
        used = rng.random(t.shape) < 0.9
        used[:, 0] = False
        of_transits = {"obs_time_bary_corr": delay, "parallax_factor_al": factor, "colour_factor_al": colour}
        of_star = {"source_id": names[s], "agis_source_excess_noise": excess}
        of_star |= dict(zip(("ra0", "dec0"), seen[:2, s] / DEGREE, strict=True))
        arrays = dict(zip(ARRAYS, (times.astype(np.int64), angles, w, error, used), strict=True))
        of_star = {name: np.full(n_transits, one) for name, one in of_star.items()}
        parts.append(Table({"transit_id": np.arange(n_transits)} | of_star | of_transits | arrays))
        for some, one in ((designs, design[:, used].T), (values, w[used]), (errors, size[used])):
            some.append(one)
        fitted.append(fit(designs[-1][:, [0, 1, 2, 3, 4, 10]], values[-1], errors[-1]))
    sky = {"scans": vstack(parts), "design": designs, "values": values, "errors": errors}
    vlbi = observed(rng, made, further, orbits, names)
    return SimpleNamespace(satellite=as_table(fitted, seen, names), vlbi=vlbi, origin=seen, **sky)


def fit(design, values, errors):
    normal = (design / errors[:, None] ** 2).T @ design
    normal[-1, -1] += 0.085e-3**-2
    covariance = np.linalg.inv(normal)
    return covariance @ (design / errors[:, None] ** 2).T @ values, covariance


def as_table(fitted, origin, names):
    values = np.array([one[0][:5] for one in fitted]).T * MAS
    values[0] = origin[0] + values[0] / np.cos(origin[1])
    values[1] += origin[1]
    sigma, correlations = by_errors(np.array([one[1] for one in fitted])[:, :5, :5])
    correlations = np.array([correlations[pair] for pair in PAIRS])
    made = replace(stars(len(names), 1, epoch=EPOCH), radial_velocity=np.zeros(len(names)))
    return gaia_table(replace(made, values=values, errors=sigma * MAS, correlations=correlations), source_id=names)


def observed(rng, made, further, orbits, names, number=3):
    source, size = np.repeat(np.arange(len(names)), number), number * len(names)
    one, epoch = made.taken(source), rng.uniform(2008.0, 2026.0, size)
    values = propagated(one.values, None, one.epoch, epoch)
    bent = np.einsum("nij,nj->in", bends(epoch - EPOCH, orbits[:, source])[:, :2], further[source])
    errors = np.full((5, size), 0.1 * MAS)
    errors[:2] = rng.uniform(0.05, 0.15, (2, size)) * MAS
    step = bent + parallax_factors(*values[:2], epoch) * values[2] + errors[:2] * rng.normal(size=(2, size))
    values[:2] += step / np.array([np.cos(values[1]), np.ones(size)])
    rows = only(one, POSITION, values=values, errors=errors, epoch=epoch, correlations=np.zeros((10, size)))
    return gaia_table(rows, source_id=names[source])


def written(folder, scans, form="ecsv", units=True):
    table, path = scans.copy(), folder / f"scans.{form.rpartition('.')[2]}"
    for name, unit in UNITS.items() if units else ():
        table[name].unit = unit
    frame = pd.DataFrame({name: table[name].tolist() for name in table.colnames})
    if form == "flat.fits":  # a row for each CCD
        Table.from_pandas(frame.explode([*ARRAYS]).infer_objects(), units=UNITS).write(path)
    elif form == "csv":
        frame[[*ARRAYS]] = frame[[*ARRAYS]].map(lambda cell: f"({json.dumps(cell)[1:-1]})")
        frame.to_csv(path, index=False)
    elif form == "dpac.parquet":
        frame.rename(columns=lambda name: re.sub("_([a-z])", lambda result: result[1].upper(), name)).to_parquet(path)
    else:
        table.write(path, overwrite=True, **({"format": "votable"} if form == "xml" else {}))
    if form == "xml":  # arrays of any length, as the archive has them
        path.write_text(path.read_text().replace('"9" datatype="long"', '"*" datatype="long"'))
    return path


def linked(folder, sky, form="fits", units=True, **options):
    sky.satellite.write(folder / "gaia.fits", overwrite=True)
    sky.vlbi.write(folder / "vlbi.fits", overwrite=True)
    options |= {"epochs": [written(folder, sky.scans, form, units)], "errors": "formal"}
    return linksweep.tie(folder / "gaia.fits", folder / "vlbi.fits", "orientation,spin", **options)


def with_every_parameter(link, sky, models, shared):
    """Return unknowns, covariance, squares and paths from one large system of observations and differences, in mas,
    whose last unknowns are the errors that the differences of a star share, in units of their size ``shared``.
    """
    free = [np.array([*range(5), *(5 + k for k in BENDS[model]), 10]) for model in models]
    end = 6 + 11 * len(models)
    scale = np.ones(end + 2 * len(models))
    scale[16:end:11] = 1e-4  # of colours
    blocks, right, alone = [], [], []

    def add(s, of_frame, of_star, values, errors, of_shared=0.0):
        block = np.zeros((len(values), len(scale)))
        block[:, :6], block[:, 6 + 11 * s : 17 + 11 * s] = of_frame, of_star
        block[:, end + 2 * s : end + 2 * s + 2] = of_shared
        blocks.append(block * scale / errors[:, None])
        right.append(values / errors)

    for s, used in enumerate(free):
        a, y = np.vstack([sky.design[s], np.eye(11)[10]]), np.append(sky.values[s], 0.0)
        errors, unit = np.append(sky.errors[s], 0.085e-3), scale[6 + used]
        result = np.zeros(11)
        result[used] = unit * np.linalg.lstsq(a[:, used] * unit / errors[:, None], y / errors, rcond=None)[0]
        alone.append(result)
        add(s, 0.0, a, y - a @ result, errors)
        add(s, 0.0, 0.0, np.zeros(2), np.ones(2), np.eye(2))
    for r, s in enumerate(link.row_source_index.values):
        ra, dec = np.radians([link.ra.values[s], link.dec.values[s]])
        turn, years = turned(ra, dec), link.row_epoch.values[r] - EPOCH
        bend = bends(np.array([years]), ORBIT[:, None])[0, :2]
        factors = parallax_factors(np.array([ra]), np.array([dec]), link.row_epoch.values[[r]])
        partials = np.hstack([np.eye(2), factors, years * np.eye(2), bend, np.zeros((2, 1))])
        errors = np.array([sky.vlbi["ra_error"][r], sky.vlbi["dec_error"][r]])
        add(s, np.hstack([turn, years * turn]), partials, link.difference.values[r, :2], errors, shared * np.eye(2))
    at = np.concatenate([np.arange(6), *(6 + 11 * s + used for s, used in enumerate(free)), np.arange(end, len(scale))])
    matrix, right = np.concatenate(blocks)[:, at], np.concatenate(right)
    result, covariance = np.zeros(len(scale)), np.zeros(2 * scale.shape)
    result[at] = scale[at] * np.linalg.lstsq(matrix, right, rcond=None)[0]
    covariance[np.ix_(at, at)] = np.linalg.inv(matrix.T @ matrix) * scale[at] * scale[at, None]
    squares = np.sum((right - matrix @ (result[at] / scale[at])) ** 2)
    sigma = np.sqrt(np.diag(covariance))[6:end].reshape(-1, 11)
    paths = np.array(alone) + result[6:end].reshape(-1, 11)
    each = zip(paths, sigma, free, strict=True)
    return result[:6], covariance[:6, :6], squares, [(path[used], error[used], used) for path, error, used in each]


def orbits(folder, names, campbell=False):
    table = Table({"source_id": np.asarray(names, dtype=np.int64)})
    table["period"], table["eccentricity"], table["ref_epoch"] = ORBIT[0] * 365.25, ORBIT[1], EPOCH - 1.5 * campbell
    table["t_periastron"] = (ORBIT[2] + EPOCH - table["ref_epoch"]) * 365.25
    table["t_periastron"] += 0.0 if campbell else 51544.5 + 365.25 * (EPOCH - 2000.0)  # as a Julian date
    if campbell:
        table["ref_epoch"] = 2451545.0 + 365.25 * (table["ref_epoch"] - 2000.0)
        for name, angle in (("nodeangle", NODE), ("inclination", INCLINATION), ("arg_periastron", PERIASTRON)):
            table[name] = np.degrees(angle)
    for letter, value in zip("" if campbell else "abfg", () if campbell else ORBIT[3:], strict=True):
        table[f"{letter}_thiele_innes"] = 3.2 * value
    table.write(folder / "orbits.ecsv", overwrite=True)
    return folder / "orbits.ecsv"


def models_of(folder, sky, models, campbell=False):
    names = sky.satellite["source_id"].astype(str)
    chosen = {"star_models": {names[s]: model for s, model in enumerate(models) if model in ("7", "9")}}
    bound = names[np.array(models) == "orbit"]
    return chosen | ({"orbits": orbits(folder, bound, campbell)} if len(bound) else {})


@settings(max_examples=examples(20, quick=2), deadline=None, phases=[Phase.generate], derandomize=True)
@given(st.integers(0, 10**6), PATHS, st.integers(14, 30), st.booleans())
def test_a_link_is_that_of_all_observations_with_every_parameter(tmp_path_factory, seed, models, n_transits, noisy):
    folder = tmp_path_factory.mktemp("scans")
    models = ["5"] * len(models) if noisy else models  # the noise of AGIS is that of straight paths
    sky = drawn(seed, models, n_transits, excess=0.1 * noisy)
    sky.scans = sky.scans[np.random.default_rng(seed).permutation(len(sky.scans))]
    chosen = models_of(folder, sky, models, campbell=bool(seed % 2))
    sky.vlbi["calibrator"], sky.vlbi["calibrator_error"] = "J1", 0.2  # mas
    link = linked(folder, sky, epoch=EPOCH, accept_misfit=True, **chosen)
    assert link.path_model.values.tolist() == models
    estimate, covariance, squares, paths = with_every_parameter(link, sky, models, 0.2)
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(link.estimate / error, estimate / error, atol=1e-3)
    np.testing.assert_allclose(link.covariance / np.outer(error, error), covariance / np.outer(error, error), atol=1e-3)
    assert float(link.chi2) + float(link.path_chi2.sum()) == pytest.approx(squares, rel=1e-4)
    # the colour is an unknown and has an expectation
    dof = [len(y) - 5 - len(BENDS[model]) for y, model in zip(sky.values, models, strict=True)]
    assert link.path_dof.values.tolist() == dof
    each = zip(link.path_estimate.values, link.path_error.values, paths, strict=True)
    for result, errors, (path, sigma, free) in each:
        np.testing.assert_allclose(result[free] / sigma, path / sigma, atol=2e-3)
        np.testing.assert_allclose(errors[free], sigma, rtol=1e-3)
        assert np.isnan(np.delete(result, free)).all()
    assert np.all(np.abs(link.estimate.values - np.array([*EPSILON, *OMEGA]) / MAS) < 5.0 * error)
    assert link.attrs["misfit"] == ""


@pytest.mark.parametrize("form", few(2, ["xml", "csv", "flat.fits", "ecsv", "parquet", "dpac.parquet"]))
def test_each_format_is_read_and_gives_the_link_of_what_gaiasupdate_finds(tmp_path, form):
    from gaiasupdate.epoch_astrometry import GaiaEpochAstrometryArchive

    sky = drawn(5, ["5"] * 4, excess=0.15)
    frame = pd.DataFrame({name: sky.scans[name].tolist() for name in sky.scans.colnames})
    frame["ccd_proc_flags"] = frame["ipd_error_al"] = frame["used_by_agis_al"]
    frame["nu_eff_used_in_astrometry"] = 0.0016
    names = sky.satellite["source_id"].tolist()
    each = [GaiaEpochAstrometryArchive.supdate(frame, name) for name in names]
    fitted = [(one["parameters"], one["parameter_covariance_matrix_formal"]) for one in each]
    as_table(fitted, sky.origin, names).write(tmp_path / "supdate.fits")
    link = linked(tmp_path, sky, form=form)
    same = linksweep.tie(tmp_path / "supdate.fits", tmp_path / "vlbi.fits", "orientation,spin", errors="formal")
    np.testing.assert_allclose(link.estimate / link.error, same.estimate / same.error, atol=3e-4)
    np.testing.assert_allclose(link.error, same.error, rtol=3e-4)
    assert link.attrs["misfit"] == same.attrs["misfit"] == ""
    assert link.sizes["transit"] == len(sky.scans)
    assert float((link.transit_residual / link.transit_error).std()) == pytest.approx((19 / 24) ** 0.5, abs=0.15)


def times(name, factor, add=0.0, then=np.array):
    return lambda sky: sky.scans.replace_column(name, then(sky.scans[name] * factor + add))


def put(name, at, value):
    return lambda sky: sky.scans[name].__setitem__(at, value)


def angles_of_one_star(sky):
    sky.scans["scan_pos_angle"] *= np.where(sky.scans["source_id"] == 10**17, -1.0, 1.0)[:, None]


def one_binary(sky):
    far = 9.0 * np.sin(np.array(sky.scans["obs_time_tcb"]) / 2e16) * np.sin(np.radians(sky.scans["scan_pos_angle"]))
    sky.scans["centroid_pos_al"] += far * (sky.scans["source_id"] == sky.scans["source_id"][0])[:, None]


def of_dr3(sky):
    sky.satellite["ref_epoch"] = 2016.0
    sky.scans.remove_columns(["ra0", "dec0"])


def two_models(sky):
    sky.satellite["v"] = [*"ABCD"]
    return {"star_models": {"A": "7", str(10**17): "9"}}


NS_PER_YEAR, CHI2 = 3.15576e16, "the likely cause: "
MISTAKES = {  # what changes tables, and the words of a misfit
    "times 1.5 years late": (times("obs_time_tcb", 1.0, 1.5 * NS_PER_YEAR), f"{CHI2}times 1.5 years too late"),
    "angles in radians": (times("scan_pos_angle", DEGREE), f"{CHI2}scan angles in radians, taken for degrees"),
    "angles from east": (times("scan_pos_angle", -1.0, 90.0), f"{CHI2}sine and cosine of the scan angles exchanged"),
    "angles reversed": (times("scan_pos_angle", -1.0), f"{CHI2}scan angles with reversed sign"),
    "errors in uas": (times("centroid_pos_error_al", 1e3), f"{CHI2}errors too large, uas taken for mas"),
    "excess noise in uas": (times("agis_source_excess_noise", 1e3), f"{CHI2}excess noise, uas taken for mas"),
    "large noise": (times("agis_source_excess_noise", 1e6), "expectation; errors or excess noise are too large"),
    "one transit": (put("centroid_pos_al", 3, 30.0), rf"{CHI2}the transit of {10**17} at 20\d\d\.\d\d alone"),
    "a binary": (one_binary, f"of {10**17} is .*not single, whose paths --star-model and --orbits give"),
    "parallax": (times("parallax_factor_al", -1.0), f"{CHI2}parallax factors with reversed sign"),
    "positions in arcsec": (times("centroid_pos_al", 1e-3), f"{CHI2}positions along the scan, arcsec taken for mas"),
    "whole degrees": (times("scan_pos_angle", 1.0, then=np.round), "scan_pos_angle has too few digits for the errors"),
    "one star's angles": (angles_of_one_star, "of 100000000000000000 .*scan angles with reversed sign"),
}
REFUSALS = {  # what changes tables, or options; and the words of an error
    "years": (times("obs_time_tcb", 1.0 / NS_PER_YEAR, 2010.0), "is not ns since 2010.0"),
    "a column": (lambda sky: sky.scans.remove_column("obs_time_bary_corr"), "no column obs_time_bary_corr"),
    "DR3": (of_dr3, "take the table of the same release"),
    "large angles": (times("scan_pos_angle", 1.0, 620.0), r"scan_pos_angle outside -360\.\.360 deg in row 1, 2"),
    "a unit": (lambda sky: setattr(sky.scans["ra0"], "unit", "m"), "column 'ra0': 'm'.* and 'rad'"),
    "a row's origin": (put("ra0", 3, 10.0), f"ra0 changes within {10**17}$"),
    "other stars": (times("source_id", 1, 5000 - 10**17), "no source 5000, 5007"),
    "nothing used": (times("used_by_agis_al", 0), "no observation in .* was used by AGIS"),
    "twice": (lambda sky: setattr(sky, "scans", vstack([sky.scans, sky.scans[:3]])), "observations are there twice"),
    "a model": ({"star_models": {"all": "6"}}, "models are 5, 7, 9, orbit"),
    "a star": ({"star_models": {"S1": "7"}}, "stars with observations"),
    "two models": (two_models, f"model 9 of {10**17}, which has the model 7 too"),
    "an orbit": ({"star_models": {str(10**17): "orbit"}}, f"no elements of the orbit of {10**17}"),
}


@pytest.mark.parametrize("mistake", [*REFUSALS, *(m if m == "errors in uas" else slow(m) for m in MISTAKES)])
def test_a_mistake_is_refused_or_named_with_its_cause(tmp_path, mistake):
    change, said = (MISTAKES | REFUSALS)[mistake]
    sky = drawn(len(mistake), ["5"] * 4, excess=0.02 * (len(mistake) % 2))
    options = change if isinstance(change, dict) else change(sky) or {}
    try:
        link = linked(tmp_path, sky, units=False, accept_misfit=True, **options)
        result, refused = " ".join(link.attrs["notes"]), False
    except linksweep.SweepError as error:
        result, refused = str(error), True
    assert re.search(said, result), result
    assert refused == (mistake in REFUSALS)


def test_stars_without_observations_and_strangers_are_named(tmp_path):
    sky = drawn(3, ["5"] * 6)
    star = sky.scans["source_id"].copy()
    sky.scans["source_id"] = np.where(star == star[0], 77, star)
    sky.scans["ra0"][star == star[-1]] = np.nan
    sky.satellite["ra"][1:-1] += 5.0 / 3.6e6  # of rows that nothing is relative to
    sky.scans["parallax_factor_al"][-2:] = np.nan
    link = linked(tmp_path, sky, star_models={"all": "7", str(star[-1]): "5"}, accept_misfit=True)
    assert np.all(np.abs(link.estimate.values[:3] - EPSILON / MAS) < 0.5)
    lost = f"{np.sum(sky.scans['used_by_agis_al'][-2:])} observations have no parallax_factor_al .* row 143, 144"
    assert re.search(lost, " ".join(link.attrs["notes"]))
    no_source = "no source 77, of which there are observations"
    without = f"without ra0 and dec0 transits are relative to the row: {star[-1]}"
    no_observations = "no observations of 100000000000000000, which keep their rows"
    assert all(words in " ".join(link.attrs["notes"]) for words in (no_source, no_observations, without))
    assert link.path.values.tolist() == sky.satellite["source_id"].astype(str)[1:].tolist()
    assert link.path_model.values.tolist() == ["7"] * 4 + ["5"]


def test_an_orbit_is_that_of_one_star_and_one_that_is_not_on_the_sky_is_none(tmp_path):
    sky, blank = drawn(4, ["orbit", "5", "5", "5"], bend=3.0), [None] * 7
    one = [10**17, *ORBIT[:3] * [365.25, 1.0, 365.25], *ORBIT[3:]]
    names = ("source_id", "period", "eccentricity", "t_periastron", *(f"{k}_thiele_innes" for k in "abfg"))
    names += ("nodeangle", "inclination", "arg_periastron")
    angles = np.degrees([NODE, INCLINATION, PERIASTRON]).tolist()

    def link(*rows, **options):
        pd.DataFrame(rows, columns=names).to_csv(tmp_path / "orbits.csv", index=False)
        return linked(tmp_path, sky, orbits=tmp_path / "orbits.csv", accept_misfit=True, **options)

    sky.vlbi = drawn(4, ["5"] * 4).vlbi
    result = link([*one, *angles], [10**17 + 7, 30.0, 0.0, 0.0, *blank], [10**17 + 14, 30.0, *[0.0] * 6, *blank[4:]])
    assert result.path_model.values.tolist() == ["orbit", "5", "5", "5"]
    assert "the likely cause: orbits of the satellite that the other table does not have" in result.attrs["misfit"]
    assert "orbits.csv: no orbit on the sky, and so none that is used, in row 2, 3" in result.attrs["notes"]
    for rows, options, said in (
        ([[*one, *angles], [*one[:4], *blank[:4], *angles]], {}, "one of several orbits of a star in row 1, 2"),
        ([[*one, 0.0, *angles[1:]]], {}, "elements and angles of two orbits in row 1"),
        ([[5, *one[1:], *angles]], {}, "no whole orbit of a star with observations"),
        ([[*one, *angles]], {"star_models": {str(10**17): "7"}}, f"model 7 of {10**17}, which has the model orbit"),
    ):
        with pytest.raises(linksweep.SweepError, match=said):
            link(*rows, **options)


def test_paths_with_observations_take_the_place_of_rows_with_accelerations(tmp_path):
    sky = drawn(2, ["7"] * 4, bend=3.0)
    fits = [fit(a[:, [*range(7), 10]], *rest) for a, *rest in zip(sky.design, sky.values, sky.errors, strict=True)]
    sky.satellite = as_table(fits, sky.origin, sky.satellite["source_id"])
    for k, name in enumerate(("accel_ra", "accel_dec"), 5):
        sky.satellite[name] = [values[k] for values, _ in fits]
        sky.satellite[f"{name}_error"] = [np.sqrt(covariance[k, k]) for _, covariance in fits]
    links = [linked(tmp_path, sky, star_models={"all": "7"}, accelerations=how) for how in ("at-epoch", "mean")]
    np.testing.assert_array_equal(links[0].estimate, links[1].estimate)  # they are not averages
    assert links[0].attrs["misfit"] == ""


def test_the_command_takes_files_after_epochs_and_text_in_them_is_never_run(tmp_path, sweep):
    sky = drawn(2, ["5", "7", "5", "5"], bend=0.2)
    whole = linked(tmp_path, sky, star_models={str(sky.satellite["source_id"][1]): "7"})
    half = len(sky.scans) // 2
    for name, part in (("one.fits", sky.scans[:half]), ("two.fits", sky.scans[half:])):
        part.write(tmp_path / name)
    model = f"{sky.satellite['source_id'][1]}=7"
    command = ["tie", "gaia.fits", "vlbi.fits", "--unknowns", "orientation,spin", "--epochs", "one.fits", "two.fits"]
    out = sweep(*command, "--star-model", model, "-o", "tie.zarr", "--json", cwd=tmp_path, code=0)[1]
    assert json.loads(out)  # nothing else is printed there
    np.testing.assert_allclose(linksweep.open(tmp_path / "tie.zarr").estimate, whole.estimate, rtol=1e-6, atol=1e-9)
    assert "one.fits" in sweep("tie", "gaia.fits", "vlbi.fits", "one.fits", cwd=tmp_path, code=2)[2]
    linked(tmp_path, drawn(1, ["5"] * 3), form="csv")
    path, run = tmp_path / "scans.csv", f"__import__('pathlib').Path('{tmp_path}/ran').touch()"
    path.write_text(re.sub(r'"\(.*?"', f'"{run}"', path.read_text(), count=1))
    with pytest.raises(linksweep.SweepError, match="cannot be read as epoch astrometry"):
        linksweep.tie(tmp_path / "gaia.fits", tmp_path / "vlbi.fits", epochs=[path])
    assert not (tmp_path / "ran").exists()


def test_studies_and_forecasts_have_the_errors_of_the_transits(tmp_path):
    models, unknowns = {"1003": "7", "1006": "7"}, "orientation,spin"
    tables = [str(built_in(Path(name))) for name in ("dr4-gaia", "dr4-vlbi", "dr4-epochs")]
    link = linksweep.tie(*tables[:2], unknowns, epochs=tables[2:], star_models=models)
    formal = link.errors.sel(error_kind="formal").values
    plan = linksweep.forecast(*tables[:2], unknowns, epochs=tables[2:], star_models=models)
    np.testing.assert_allclose(plan.error.sel(stage="now"), formal)
    fixed = {"satellite": tables[0], "reference": tables[1], "epochs": {"all": tables[2]}, "star_models": models}
    study = {"title": "t", "experiment": "linksweep.sweep.tie.experiment:tie", "sampling": {"n_sim": 100}}
    result = linksweep.run(study | {"fixed": fixed, "axes": {"clip": ["none"]}}, tmp_path / "s.zarr", pool="serial")
    np.testing.assert_allclose(result.estimate.values[0, :6], link.estimate.values)
    np.testing.assert_allclose(result.error_formal.values[0, :6], formal)
    np.testing.assert_allclose(result.sigma.values[0, :6], formal, rtol=0.25)
