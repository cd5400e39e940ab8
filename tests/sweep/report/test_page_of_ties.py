"""What a page, a table and the answer say about a study of ties: the solution of the tables comes before the draws."""

import re
from dataclasses import replace

import numpy as np
import pytest

import linksweep
from tests.core.tie.made import MAS, gaia, noise, propagated, seen_by_satellite, stars
from tests.sweep.analysis.made import report_of

KINDS = ("scaled", "jackknife", "formal")
CLIPS = ("none", "discrepancy:3")
pytestmark = pytest.mark.slow  # drawing, of links with all their errors

LABELS = ("epsilon_x", "epsilon_y", "epsilon_z", "omega_x", "omega_y", "omega_z")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A study of radio stars whose errors are three times too small, over the clip and, in vain, the draws' errors."""
    folder = tmp_path_factory.mktemp("ties")
    rng = np.random.default_rng(7)
    made = stars(25)
    seen = replace(made, values=seen_by_satellite(made, np.array([0.4, -0.3, 0.9]) * MAS, np.zeros(3)))
    earlier = propagated(made.values, made.radial_velocity, made.epoch, np.full(25, 2008.0))
    earlier[0] %= 2.0 * np.pi
    reference = replace(made, values=earlier, epoch=np.full(25, 2008.0))
    for name, one in (("satellite", seen), ("reference", reference)):
        gaia(folder / f"{name}.ecsv", replace(one, values=one.values + 3.0 * noise(rng, one)))
    lines = (
        'title = "Radio stars"',
        'experiment = "linksweep.sweep.tie.experiment:tie"',
        "[fixed]",
        'satellite = "satellite.ecsv"',
        'reference = "reference.ecsv"',
        "[axes]",
        f"clip = {list(CLIPS)}",
        "error_factor = [1.0, 2.0]",
        "[sampling]",
        "n_sim = 4",
    )
    (folder / "study.toml").write_text("\n".join(lines))
    linksweep.run(folder / "study.toml", folder / "s.zarr", pool="serial")
    return folder / "s.zarr"


@pytest.fixture(scope="module")
def page(store):
    return report_of([store])


def links(store):
    """The links of the same tables by `linksweep.tie`, clip by clip."""
    tables = store.parent / "satellite.ecsv", store.parent / "reference.ecsv"
    return {clip: linksweep.tie(*tables, "orientation,spin", clip=clip, errors=",".join(KINDS)) for clip in CLIPS}


def tables_of(page):
    """The tables of a page by caption: rows of text, and of numbers where cells have one."""
    found = {}
    for name, body in re.findall(r"<summary>(.*?) \(\d+ rows?\)</summary>(.*?)</details>", page, re.DOTALL):
        headings = re.findall(r'<th scope="col"><button type="button">(.*?)</button>', body)
        rows = [
            [value or text for value, text in re.findall(r'<td[^>]*?(?:data-value="([^"]*)")?>(.*?)</td>', row)]
            for row in re.findall(r"<tr>(<td.*?)</tr>", body, re.DOTALL)
        ]
        found[name] = [dict(zip(headings, row, strict=True)) for row in rows]
    return found


def test_a_page_has_the_estimate_and_every_kind_of_error_along_the_axes(store, page):
    """Jackknife errors of 155 uas were nowhere on a page that headlined 31 uas."""
    found = [t for name, t in tables_of(page).items() if name.startswith("estimate [")]
    rows = {(row["clip"], row["component"]): row for table in found for row in table}
    assert len(rows) == sum(map(len, found)) == 12  # not again for the errors of the draws
    for clip, link in links(store).items():
        for k, label in enumerate(LABELS):
            row = rows[clip, label]
            assert "error_factor" not in row
            factor = {"m": 1.0, "µ": 1e3}[next(name for name in row if name.startswith("estimate"))[10]]
            numbers = {re.sub(r" \[.*\]$", "", name): text for name, text in row.items()}
            assert float(numbers["estimate"]) == pytest.approx(factor * float(link.estimate[k]), rel=1e-6)
            for kind in KINDS:
                expected = factor * float(link.errors.sel(error_kind=kind)[k])
                assert float(numbers[f"error_{kind}"]) == pytest.approx(expected, rel=1e-6)


def test_chi2_is_a_headline_result(store, page):
    results = tables_of(page)["Headline results, ± their one-sigma errors"]
    for clip, link in links(store).items():
        ratios = [float(row["chi2_ratio"]) for row in results if row["clip"] == clip]
        assert ratios == pytest.approx([float(link.chi2 / link.chi2_expected)] * 2)
    assert max(float(row["chi2_ratio"]) for row in results) > 5.0  # errors are three times too small


def test_the_head_of_a_link_is_its_result(tmp_path, sweep):
    assert sweep("tie", "psrpi-de200", "timing-de200", "--unknowns", "orientation", "-o", tmp_path / "t.zarr")[0] == 0
    assert sweep("report", tmp_path / "t.zarr", "-o", tmp_path / "t.html")[0] == 0
    link, page = linksweep.open(tmp_path / "t.zarr"), (tmp_path / "t.html").read_text()
    head = re.search(r'class="headline"><p>(.*?)</p>', page)[1]
    values = {
        name: (float(value), float(error)) for name, value, error in re.findall(r"(\w+) = (\S+) ± (\S+) mas", head)
    }
    for k, name in enumerate(link["unknown"].values.tolist()):
        assert values[name] == pytest.approx((link.estimate[k].item(), link.errors[0, k].item()), abs=0.06)
    assert f"({link['error_kind'][0].item()} errors)" in head
