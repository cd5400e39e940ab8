"""What a page, a table and the answer say about a study of ties: the solution of the tables comes before the draws."""

import re

import numpy as np
import pytest

import linksweep
from tests.sweep.analysis.made import report_of
from tests.sweep.tie.test_against_least_squares import drawn_tables

KINDS = ("scaled", "jackknife", "formal")
CLIPS = ("none", "discrepancy:3")
pytestmark = pytest.mark.slow  # drawing, of links with all their errors
LABELS = ("epsilon_x", "epsilon_y", "epsilon_z", "omega_x", "omega_y", "omega_z")


def tables_of(page):
    found = {}
    for name, body in re.findall(r"<summary>(.*?) \(\d+ rows?\)</summary>(.*?)</details>", page, re.DOTALL):
        headings = re.findall(r'<th scope="col"><button type="button">(.*?)</button>', body)
        rows = re.findall(r"<tr>(<td.*?)</tr>", body, re.DOTALL)
        rows = [re.findall(r'<td[^>]*?(?:data-value="([^"]*)")?>(.*?)</td>', row) for row in rows]
        rows = [[value or text for value, text in cells] for cells in rows]
        found[name] = [dict(zip(headings, row, strict=True)) for row in rows]
    return found


def test_a_page_has_the_estimate_and_every_kind_of_error_along_the_axes_and_chi2_as_a_headline_result(tmp_path):
    drawn_tables(tmp_path, 7, n=25, free=0, scale=3.0)
    tables = {name: f"{tmp_path}/{name}.fits" for name in ("satellite", "reference")}
    study = {"title": "Radio stars", "experiment": "linksweep.sweep.tie.experiment:tie", "sampling": {"n_sim": 4}}
    study |= {"fixed": tables, "axes": {"clip": list(CLIPS), "error_factor": [1.0, 2.0]}}
    linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    options = {"unknowns": "orientation,spin", "errors": ",".join(KINDS)}
    links = {clip: linksweep.tie(*tables.values(), clip=clip, **options) for clip in CLIPS}
    page = tables_of(report_of([tmp_path / "s.zarr"]))
    found = [table for name, table in page.items() if name.startswith("estimate [")]
    rows = {(row["clip"], row["component"]): row for table in found for row in table}
    assert len(rows) == sum(map(len, found)) == 12  # not again for the errors of the draws
    for clip, link in links.items():
        for k, label in enumerate(LABELS):
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


def head_of(store, sweep):
    assert sweep("report", store, "-o", store.with_suffix(".html"))[0] == 0
    return re.search(r'class="headline">(.*?)</div>', store.with_suffix(".html").read_text())[1]


def test_the_head_of_a_link_is_its_result(tmp_path, sweep):
    assert sweep("tie", "psrpi-de200", "timing-de200", "--unknowns", "orientation", "-o", tmp_path / "t.zarr")[0] == 0
    link, head = linksweep.open(tmp_path / "t.zarr"), head_of(tmp_path / "t.zarr", sweep)
    length, error, *components = map(float, re.findall(r"-?[\d.]+\d", head))
    estimate, covariance = link["estimate"].values, link["covariance"].values
    assert components == pytest.approx(estimate.tolist(), abs=0.006)
    assert length == pytest.approx(np.linalg.norm(estimate), abs=0.006)
    drawn = np.random.default_rng(1).multivariate_normal(estimate, covariance, 4000)
    assert error == pytest.approx(np.linalg.norm(drawn, axis=1).std(), rel=0.05)
    assert f"{link['error_kind'][0].item()} errors" in head


def test_the_head_of_a_forecast_is_what_observing_brings(tmp_path, sweep):
    options = ("--unknowns", "orientation,spin", "--add", "2026", "--choose", "2", "--for", "spin")
    assert sweep("forecast", "psrpi", "psrpi", *options, "-o", tmp_path / "f.zarr")[0] == 0
    plan, head = linksweep.open(tmp_path / "f.zarr"), head_of(tmp_path / "f.zarr", sweep)
    stages = [*plan["error"].values, plan["step_error"].values[-1]]
    expected = [1e3 * np.sqrt(np.mean(errors[plan["block"].values == "spin"] ** 2)) for errors in stages]
    assert list(map(float, re.findall(r"([\d.]+) µas/yr", head))) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("command", [("scaling", "quasars", "--workers", "1", "--repetitions", "1"), ("sensitivity",)])
def test_what_a_command_writes_can_be_shown_and_reported(store_of, tmp_path, sweep, command):
    more = ("--set", "n_cat=1", "--set", "n_sim=2") if command[0] == "scaling" else (store_of("quasars"),)
    assert sweep(*command, *more, "-o", tmp_path / "m.zarr")[0] == 0
    shown = sweep("show", tmp_path / "m.zarr", "--json")
    assert shown[0] == 0
    assert sweep("report", tmp_path / "m.zarr", "-o", tmp_path / "m.html")[0] == 0
    [table] = tables_of((tmp_path / "m.html").read_text()).values()
    assert len(table) == 2
