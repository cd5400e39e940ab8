"""Links of the built-in tables: what was published, differences, harmonics as quadrupoles; and with the commands."""

import json
import re

import numpy as np
import pytest
from scipy.stats import f

import linksweep
from tests.conftest import run_sweep
from tests.core.tie.made import Objects, parse_unknowns
from tests.sweep.analysis.made import report_of, report_page
from tests.sweep.tie.test_against_least_squares import drawn_tables

PULSARS = "psrpi-de200", "timing-de200", "orientation"
LINK = ("psrpi-de200", "timing-de200", "--unknowns", "orientation", "--clip", "discrepancy", "--errors", "jackknife")
PLAN = ("psrpi", "psrpi", "--unknowns", "orientation", "--add", "2030")
KINDS = ("scaled", "jackknife", "formal")
CLIPS = ("none", "discrepancy:3")


def test_icrf2_against_icrf3_and_timing_on_de200_against_vlbi():
    link = linksweep.tie("icrf3", "icrf2", degree=2, clip="rayleigh")
    assert (int(link.n_sources_matched), int(link.n_sources)) == (3410, 3237)
    np.testing.assert_array_equal(np.round(1000.0 * link.estimate[:6]), [11, 14, -1, 22, 63, 89])
    np.testing.assert_array_equal(np.round(1000.0 * link.error[:6]), [4, 4, 3, 4, 4, 4])
    assert link.attrs["sign"] == "reference-satellite"
    assert list(link.attrs["notes"]) == ["of orientation and spin the tables determine only the orientation"]
    link = linksweep.tie(*PULSARS)
    assert int(link.n_sources) == 9
    np.testing.assert_allclose(link.estimate, [-0.90, -13.04, -12.18], atol=0.035)
    np.testing.assert_allclose(link.error, [0.99, 1.21, 0.48], atol=0.015)


def field(amplitudes, ra, dec):
    """The displacements to the east and north of Charlot et al. 2020, Eq. 5, with our sign of R."""
    a = {name.split(" ")[1]: value for name, value in amplitudes.items()}
    s, c = np.sin, np.cos
    east = -a["R_x"] * c(ra) * s(dec) - a["R_y"] * s(ra) * s(dec) + a["R_z"] * c(dec)
    north = a["R_x"] * s(ra) - a["R_y"] * c(ra)
    east += -a["G_x"] * s(ra) + a["G_y"] * c(ra)
    north += -a["G_x"] * c(ra) * s(dec) - a["G_y"] * s(ra) * s(dec) + a["G_z"] * c(dec)
    east += a["M_20"] * s(2 * dec) - (a["M_21_re"] * c(ra) - a["M_21_im"] * s(ra)) * c(2 * dec)
    east += (a["E_21_re"] * s(ra) + a["E_21_im"] * c(ra)) * s(dec)
    east -= (a["M_22_re"] * c(2 * ra) - a["M_22_im"] * s(2 * ra)) * s(2 * dec)
    east -= 2 * (a["E_22_re"] * s(2 * ra) + a["E_22_im"] * c(2 * ra)) * c(dec)
    north += a["E_20"] * s(2 * dec) - (a["E_21_re"] * c(ra) - a["E_21_im"] * s(ra)) * c(2 * dec)
    north -= (a["M_21_re"] * s(ra) + a["M_21_im"] * c(ra)) * s(dec)
    north -= (a["E_22_re"] * c(2 * ra) - a["E_22_im"] * s(2 * ra)) * s(2 * dec)
    north += 2 * (a["M_22_re"] * s(2 * ra) + a["M_22_im"] * c(2 * ra)) * c(dec)
    return np.array([east, north])


def test_the_amplitudes_are_the_field_that_was_fitted():
    link = linksweep.tie("icrf3", "icrf2", "vsh_position:2")
    fitted = (link.difference - link.residual).sel(observable=["ra", "dec"]).values.T
    ra, dec = np.radians([link[name].values[link.row_source_index.values] for name in ("ra", "dec")])
    np.testing.assert_allclose(field(link.amplitude.to_series(), ra, dec), fitted, atol=1e-9)
    assert {*link.amplitude_unit.values} == {"mas"}
    other = linksweep.tie("icrf3", "icrf2", "vsh_position:2", sign="satellite-reference")
    np.testing.assert_array_equal(other.amplitude, -link.amplitude)
    # The norm of the harmonics (Mignard & Klioner 2012): order 0 of degree 2 is sqrt(15/32 pi) sin 2 dec.
    factor = np.sqrt(15.0 / 32.0 / np.pi)
    for harmonic, amplitude in (("s", "E"), ("t", "M")):
        one, other = f"vsh_position_{harmonic}_2_0", f"position {amplitude}_20"
        assert link.amplitude.sel(amplitude_name=other) == pytest.approx(factor * link.estimate.sel(unknown=one))
    names = link.amplitude_name.values.tolist()
    basis = np.array([field({name: float(name == one) for name in names}, ra, dec).ravel() for one in names]).T
    fields = parse_unknowns("vsh_position:2").derivatives(Objects(ra, dec, 0.0 * ra, 0.0 * ra))[1]
    made = np.linalg.lstsq(basis, fields.reshape(len(fields), -1).T, rcond=None)[0]
    errors = np.sqrt(np.einsum("ak,ekl,al->ea", made, link.covariances.values, made))
    np.testing.assert_allclose(link.amplitude_errors, errors, rtol=1e-9)
    np.testing.assert_allclose(link.amplitude_covariance, made @ link.covariance.values @ made.T, atol=1e-9)


def test_a_difference_is_at_the_epoch_and_in_the_sign_of_the_first_or_refused_where_there_is_none():
    tables = *PULSARS[:2], "orientation,spin"
    one = linksweep.tie(*tables, epoch=2010.0)
    for sign in ("reference-satellite", "satellite-reference"):
        made = linksweep.difference(one, linksweep.tie(*tables, epoch=2016.0, sign=sign))  # the same link at two epochs
        # But for terms of the second order: the motions of stars turn with the orientation.
        assert (abs(made.estimate) < 1e-4 * made.error).all()
        np.testing.assert_allclose(made.covariance, 2.0 * one.covariance.values, rtol=1e-3)
        assert made.attrs["sign"] == "reference-satellite"
    one, later = (linksweep.tie(*PULSARS, epoch=epoch) for epoch in (2010.0, 2016.0))
    beside = linksweep.tie(*PULSARS, epoch=2010.0, known_orientation=[1.0, 0.0, 0.0])
    plan = linksweep.forecast("psrpi", "psrpi", "orientation")
    for second, why in ((later, "no omega_x"), (plan, "two links"), (beside, "known_orientation is .* and none")):
        with pytest.raises(linksweep.SweepError, match=why):
            linksweep.difference(one, second)


WAYS = [("jackknife", "sandwich"), ("cells", "scaled"), ("formal", "bootstrap"), ("formal", "formal")]


@pytest.mark.parametrize(("mine", "theirs"), WAYS)
def test_chi2_of_a_difference_of_errors_from_the_scatter_of_sources_is_hotellings(mine, theirs):
    """The degrees of freedom of the sum are those of Wishart matrices with its mean and total variance."""
    ways = zip((mine, theirs), ("variance", "equal"), strict=True)  # which give other estimates
    one, other = (linksweep.tie(*PULSARS, epoch=2010.0, errors=kind, weights=weights) for kind, weights in ways)
    made, p, total = linksweep.difference(one, other), 3, 0.0
    for link, kind in ((one, mine), (other, theirs)):
        samples = float(link.samples[0])
        assert samples == np.inf if kind in ("formal", "scaled") else samples <= float(link.n_sources)
        assert samples == float(link.n_sources) or kind not in ("jackknife", "sandwich", "bootstrap")
        ours = np.linalg.solve(made.covariance.values, link.covariance.values)
        squares = np.trace(ours @ ours)  # scaled errors are wrong by one factor, with the scatter of chi2 over dof
        total += 2.0 * squares / 15.0 if kind == "scaled" else (squares + np.trace(ours) ** 2) / (samples - 1.0)
    apart, dof = one.estimate.values - other.estimate.values, p * (p + 1) / max(total, 1e-9)
    hotelling = apart @ np.linalg.inv(one.covariance.values + other.covariance.values) @ apart
    assert made.chi2.item() == pytest.approx(hotelling)
    expected = f(p, dof - p + 1).sf(hotelling * (dof - p + 1) / (p * dof))  # of formal errors that of chi2
    assert made.probability.item() == pytest.approx(expected, rel=1e-7)
    assert np.isnan(linksweep.difference(one.drop_vars("samples"), other).probability.item())


def test_a_link_is_printed_with_its_sign_stored_and_shown_again_and_one_message_where_it_is_damaged(tmp_path):
    link = run_sweep("tie", *LINK, "-o", tmp_path / "tie.zarr", code=0)[1]
    plan = run_sweep("forecast", *PLAN, "-o", tmp_path / "plan.zarr", code=0)[1]
    assert all(words in link for words in ("reference - satellite", "epsilon_y", "jackknife"))
    assert (run_sweep("show", tmp_path / "tie.zarr")[1], run_sweep("show", tmp_path / "plan.zarr")[1]) == (link, plan)
    content = json.loads(run_sweep("show", tmp_path / "tie.zarr", "--json")[1])
    assert content["variables"]["estimate"]["values"][1] == pytest.approx(-13.06, abs=0.01)
    lines = run_sweep("show", tmp_path / "tie.zarr", "--format", "csv")[1].splitlines()
    assert lines[0] == "unknown,unit,estimate,error_jackknife,error_formal,error_scaled"
    assert lines[2].startswith("epsilon_y,mas,-13.05")
    assert "reference-satellite" in run_sweep("show", tmp_path / "tie.zarr", "--format", "ecsv")[1]
    assert run_sweep("show", tmp_path / "plan.zarr", "--format", "csv")[1].startswith("unknown,unit,error_now")
    content = json.loads((tmp_path / "tie.zarr" / "zarr.json").read_text())
    content["consolidated_metadata"]["metadata"]["estimate"]["zarr_format"] = 2  # whose filters may unpickle
    (bad := tmp_path / "bad" / "bad.zarr").mkdir(parents=True)
    (bad / "zarr.json").write_text(json.dumps(content))
    said = {"--at unknown=epsilon_x": "--at chooses a part of a grid", "--variable estimate": "only its kind"}
    said = {f"plot {tmp_path}/tie.zarr {option}": message for option, message in said.items()}
    for command, message in {**said, "show bad.zarr": "estimate.zarr_format: Input should be 3"}.items():
        assert message in run_sweep(*command.split(), cwd=bad.parent, code=2)[2]
    assert [path.name for path in bad.parent.iterdir()] == ["bad.zarr"]


# ----- what pages say of links: the solution of the tables comes before the draws


def tables_of(page):
    result = {}
    for name, body in re.findall(r"<summary>(.*?) \(\d+ rows?\)</summary>(.*?)</details>", page, re.DOTALL):
        headings = re.findall(r'<th scope="col"><button type="button">(.*?)</button>', body)
        rows = re.findall(r"<tr>(<td.*?)</tr>", body, re.DOTALL)
        rows = [re.findall(r'<td[^>]*?(?:data-value="([^"]*)")?>(.*?)</td>', row) for row in rows]
        rows = [[value or text for value, text in cells] for cells in rows]
        result[name] = [dict(zip(headings, row, strict=True)) for row in rows]
    return result


@pytest.mark.slow
def test_a_page_has_the_estimate_and_every_kind_of_error_along_the_axes_and_chi2_as_a_headline_result(tmp_path):
    drawn_tables(tmp_path, 7, n=25, free=0, scale=3.0)
    tables = {name: f"{tmp_path}/{name}.fits" for name in ("satellite", "reference")}
    study = {"title": "Radio stars", "experiment": "linksweep.sweep.tie.experiment:tie", "sampling": {"n_sim": 4}}
    study |= {"fixed": tables, "axes": {"clip": list(CLIPS), "error_factor": [1.0, 2.0]}}
    linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    options = {"unknowns": "orientation,spin", "errors": ",".join(KINDS)}
    links = {clip: linksweep.tie(*tables.values(), clip=clip, **options) for clip in CLIPS}
    page = tables_of(report_of([tmp_path / "s.zarr"]))
    result = [table for name, table in page.items() if name.startswith("estimate [")]
    rows = {(row["clip"], row["component"]): row for table in result for row in table}
    assert len(rows) == sum(map(len, result)) == 12  # not again for the errors of the draws
    for clip, link in links.items():
        for k, label in enumerate(link.unknown.values.tolist()):
            row = rows[clip, label]
            assert "error_factor" not in row
            factor = {"m": 1.0, "µ": 1e3}[next(name for name in row if name.startswith("estimate"))[10]]
            numbers = {re.sub(r" \[.*\]$", "", name): text for name, text in row.items()}
            assert float(numbers["estimate"]) == pytest.approx(factor * float(link.estimate[k]), rel=1e-6)
            for kind in KINDS:
                expected = factor * float(link.errors.sel(error_kind=kind)[k])
                assert float(numbers[f"error_{kind}"]) == pytest.approx(expected, rel=1e-6)
    results = page["Headline results, ± their one-sigma errors"]
    for clip, link in links.items():
        ratios = [float(row["chi2_ratio"]) for row in results if row["clip"] == clip]
        assert ratios == pytest.approx([float(link.chi2 / link.chi2_expected)] * 2)
    assert max(float(row["chi2_ratio"]) for row in results) > 5.0  # errors are three times too small


@pytest.mark.slow
def test_the_head_of_a_forecast_is_what_observing_brings(tmp_path, sweep):
    options = ("--unknowns", "orientation,spin", "--add", "2026", "--choose", "2", "--for", "spin")
    assert sweep("forecast", "psrpi", "psrpi", *options, "-o", tmp_path / "f.zarr")[0] == 0
    assert sweep("report", tmp_path / "f.zarr", "-o", tmp_path / "f.html")[0] == 0
    head = re.search(r'class="headline">(.*?)</div>', (tmp_path / "f.html").read_text())[1]
    plan = linksweep.open(tmp_path / "f.zarr")
    assert "No figure" not in report_page([("of nothing new", linksweep.forecast("psrpi", "psrpi", "spin"))])
    stages = [*plan["error"].values, plan["step_error"].values[-1]]
    expected = [1e3 * np.sqrt(np.mean(errors[plan["block"].values == "spin"] ** 2)) for errors in stages]
    assert list(map(float, re.findall(r"([\d.]+) µas/yr", head))) == pytest.approx(expected, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("command", [("scaling", "quasars", "--workers", "1", "--repetitions", "1"), ("sensitivity",)])
def test_what_a_command_writes_can_be_shown_and_reported(store_of, tmp_path, sweep, command):
    more = ("--set", "n_cat=1", "--set", "n_sim=2") if command[0] == "scaling" else (store_of("quasars"),)
    assert sweep(*command, *more, "-o", tmp_path / "m.zarr")[0] == 0
    assert sweep("show", tmp_path / "m.zarr", "--json")[0] == 0
    assert sweep("report", tmp_path / "m.zarr", "-o", tmp_path / "m.html")[0] == 0
    [table] = tables_of((tmp_path / "m.html").read_text()).values()
    assert len(table) == 2
