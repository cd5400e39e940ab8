"""The page: its answers against plain arithmetic, its policy, its files and its command."""

import os
import re
import subprocess
import sys
from itertools import permutations

import numpy as np
import pytest
import xarray as xr
from astropy.units import Unit
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep.sweep.analysis.answer import answers, completeness
from linksweep.sweep.contract import Status
from linksweep.sweep.report.page import explorer, report_of, report_page, residuals, section
from tests.sweep import evil
from tests.sweep.analysis import made
from tests.tiers import examples, slow

VALUES = [[8.0, 4.0, 2.0], [80.0, 20.0, 10.0]]
CHIRP = '''
import numpy as np
import xarray as xr
def chirp(a: float, b: float, window: str, n: int = 9):
    """Measure the peak of a chirp,
    which a window lowers.

    The text of <i>all</i> paragraphs.

    Args:
        a: its rate.
    """
    if b == 3.0:
        raise ValueError(f"undefined at {a}")
    curve = xr.DataArray(a * (time := np.linspace(0.0, 1.0, n)), {"time": time})
    return {"peak": 3.0 * a + b, "early": a > 4.0, "both": (a - 5.0) * (b - 1.0), "curve": curve}
'''


def grid(value, status=None, **others):
    parts = {f"width_{name}": (("model", "size"), np.asarray(part, float)) for name, part in others.items()}
    return made.grid(value, x=[1.0, 2.0, 4.0], name="size", status=status, **parts).assign_attrs(complete=1)


@pytest.fixture
def results(store_of):
    return linksweep.open(store_of("quasars"))


def sentences(dataset):
    (answer,) = answers(dataset)
    return " ".join(answer.sentences)


def test_the_answer_adds_parts_of_errors_counts_what_agrees_and_says_what_is_missing_alike_or_not_finite():
    error = 0.03 * np.array(VALUES)
    predicted = np.array(VALUES) * [[1.0, 1.1, 1.0], [1.0, 1.0, 1.25]]  # off by 1 / 1.1 and 1 / 1.25
    text = sentences(grid(VALUES, mc_error=error, catalogue_error=4.0 / 3.0 * error, predicted=predicted))
    # in errors of 5 %: 0.1 / 0.05 = 2.0 and 0.25 / 0.05 = 5.0
    assert "It differs from its prediction by at most 20 % and 5.0 of its errors, at 1 point by more than 3" in text
    status = [[Status.DONE, Status.FAILED, Status.MISSING], [Status.DONE, Status.DONE, Status.EXCLUDED]]
    dataset = grid([[8.0, np.nan, np.nan], [7.0, 5.0, np.nan]], status)
    assert "It is between 5 mas (model=new, size=2) and 8 mas (model=old, size=1), over 3 points." in sentences(dataset)
    said = "Incomplete: 3 of 5 points are done, 1 missing and 1 failed. What follows is about those that are done."
    assert (completeness(dataset), completeness(grid(VALUES))) == ([said], [])
    noise = np.random.default_rng(7).standard_normal((100, 100))  # of which two differ by 5 errors
    assert not any("What changes it" in sentences(made.grid([y], 1.0, x=np.arange(100.0))) for y in noise)
    assert "What changes it" not in sentences(made.grid([np.arange(10.0)], np.nan, x=np.arange(10.0)))
    assert "n by up to 9 mas" in sentences(made.grid([np.arange(10.0)], 0.5, x=np.arange(10.0)))
    for value, phrase in (
        *((np.full((2, 3), 7.0), "7 mas"), ([[1.0, np.inf, 2.0], [1.0] * 3], "over 5 of 6 points.")),
        ([[np.nan, np.nan, 3.0], [np.nan] * 3], "3 mas at model=old, size=4"),
        ([[2.0, 2.0 + 3e-11, 2.0]] * 2, "between 2 mas (model=old, size=1) and 2.00000000003 mas (model=old, size=2)"),
        ([[0.3, 0.1 + 0.2, 0.3]] * 2, "It is 0.3 mas at 6 points, except for rounding."),
    ):
        assert phrase in sentences(grid(value))


@pytest.mark.parametrize("undone", [Status.MISSING, slow(Status.FAILED)])
def test_before_a_value_exists_nothing_is_concluded(dataset_of, undone):
    dataset = dataset_of("quasars")
    values = {name: array * np.nan for name, array in dataset.data_vars.items() if array.dtype.kind == "f"}
    status = dataset["status"] * 0 + undone
    nothing = dataset.assign(values | {"status": status}).assign_attrs(complete=0)
    said = [f"Incomplete: 0 of {status.size} points are done, {status.size} {undone.word}."]
    no, why = (" yet", "not done yet") if undone == Status.MISSING else ("", "failed")
    said.append(f"No conclusion{no}: numbers that it needs are missing ({why}).")
    assert linksweep.answer(nothing).sentences == said
    actual = section("s", nothing, 1, 100)
    assert [*actual["gaps"], *actual["short"], *actual["answers"]] == said
    page = report_page([("s.zarr", nothing)])
    assert ("[not done" in page, "Metz, M. &amp; Geffert, M. (2004). " in page) == (False, True)


def test_the_view_holds_numbers_axes_and_integers_exactly_and_knows_what_nobody_asked_for(results, tmp_path):
    actual, used, left_out = explorer(results, ["sigma_spin"], 10**6)
    suffixes = {"value": "", "error": "_mc_error", "predicted": "_rms_predicted"}
    suffixes |= {name: f"_{name}" for name in ("published", "published_rounding")}
    for view in actual["quantities"]:
        stored, shown = results[view["name"]].attrs.get("units", ""), view.get("units", [view["unit"]])
        both = [] if "(" in stored else zip(stored.split(","), shown, strict=True)  # a matrix is as it is
        factors = [Unit(one.strip()).to(other) for one, other in both] or 1.0
        for part, suffix in ((part, suffix) for part, suffix in suffixes.items() if part in view):
            name = view["name"] + (suffix if view["name"] + suffix in results else "_predicted")
            array = results[name].transpose(*view["dims"])
            if part == "error":
                array = np.hypot(array, results.get(f"{view['name']}_catalogue_error", 0.0))
            used, values = used - array.size, np.array(view[part], dtype=float).reshape(array.shape)
            np.testing.assert_allclose(values, factors * array, rtol=1e-12, err_msg=view["name"])
    assert (used, left_out) == (0, [])
    assert {"component_unit"}.isdisjoint(axis["name"] for axis in actual["axes"])
    jd = [2460000.0 + 0.1 * i for i in range(11)]
    lit = {"experiment": lambda jd, k: {"n": 2**60 + k, "small": 123456780 + k}, "axes": {"jd": jd, "k": [1, 2]}}
    actual, *_ = explorer(linksweep.run(lit, tmp_path / "s.zarr", pool="serial"), [], 10**6)
    axes, views = ({one["name"]: one for one in actual[part]} for part in ("axes", "quantities"))
    assert axes["jd"]["values"] == jd
    assert axes["jd"]["texts"] == ["2460000", *(f"2460000.{i}" for i in range(1, 10)), "2460001"]
    assert views["n"]["value"] == [str(2**60 + 1), str(2**60 + 2)] * 11
    assert views["small"]["value"] == [123456781, 123456782] * 11
    part = linksweep.run(lit | {"exclude": [{"jd": jd[1], "k": 2}]}, tmp_path / "t.zarr", pool="serial")
    part["status"][5], part["small"].attrs["scale"] = Status.FAILED, "log"
    assert explorer(part, [], 10**6)[0]["excluded"] == {"dims": ["jd", "k"], "at": [3], "refined": False}
    assert [one["scale"] for one in explorer(part, [], 10**6)[0]["quantities"]] == ["log"]


@pytest.fixture(scope="session")
def evil_store(tmp_path_factory):
    """A store whose title, question, axis values, meanings and failures are hostile."""
    path = tmp_path_factory.mktemp("evil") / "evil.zarr"
    document = {"title": f"<script>window.owned = true</script>{evil.BREAK}", "question": f"{evil.METALS[0]}?"}
    document |= {"axes": {"metal": list(evil.METALS), "coins": [1, 5, 20]}}
    document |= {"experiment": f"{evil.__file__}:experiment", "sampling": {"n_sim": 20, "n_cat": 2, "seed": 3}}
    linksweep.run(document, path, pool="serial")
    return path


def test_every_text_of_a_store_is_escaped(evil_store):
    page = report_of([evil_store])
    said = ("&lt;script&gt;window.owned = true&lt;/script&gt;", "is what failed")
    assert all(text in page for text in said)
    assert not re.search(r"<script>window|<img|No figure of share", page)  # the name of an axis value is no formula
    assert not re.search(r'<[a-z](?:[^">]|"[^"]*")*\son\w+=', page.partition("<script>")[0])


@pytest.mark.slow
def test_the_same_store_gives_the_same_bytes_in_another_process(store_of, tmp_path, sweep):
    pages = [tmp_path / "one.html", tmp_path / "two.html"]
    for page in (*pages, pages[0]):  # an earlier report is replaced
        status, out, err = sweep("report", store_of("quasars"), store_of("scatter"), "-o", page)
        assert (status, out) == (0, ""), err
    assert pages[0].read_bytes() == pages[1].read_bytes()
    names = re.findall(r'\bid="([^"]+)"', pages[0].read_text().partition("<script>")[0])
    assert len({*names}) == len(names)  # also of what is drawn twice, for wide and for narrow windows
    assert sorted(tmp_path.iterdir()) == pages


@pytest.mark.slow
def test_a_missing_package_is_named_with_what_to_do(tmp_path):
    (tmp_path / "bokeh").mkdir()
    (tmp_path / "bokeh" / "__init__.py").write_text("raise ImportError('no bokeh here')")
    command = [sys.executable, "-m", "linksweep", "report", "s.zarr"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    words = "pip install 'linksweep[report]'", "no bokeh here"
    assert (run.returncode, all(one in run.stderr for one in words)) == (2, True), run.stderr


def test_an_answer_is_question_and_sentences_as_text_and_in_a_notebook(results):
    card = linksweep.answer(results)
    question = "How well do quasars alone tie a mission's proper motions to the extragalactic frame?"
    assert str(card).splitlines() == [question, *card.sentences]
    page = card._repr_html_()
    heading, picture = "<strong>How well do quasars alone tie a mission&#x27;s", 'src="data:image/png;base64,iVBOR'
    assert (heading in page, picture in page, bool(re.search(r'alt="[^"]*v_max=14', page))) == (True, True, True)
    with pytest.raises(linksweep.SweepError, match="no result of a study"):
        linksweep.answer(xr.Dataset({"x": 1.0}))


@settings(max_examples=examples(100))
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.4, 2.0]), st.sampled_from([-10, 10]), st.sampled_from([0, 1]))
def test_the_answer_names_range_places_and_what_surely_changes_it(seed, error, low, apart):
    """Against a loop over pairs of points that differ in one parameter alone."""
    rng = np.random.default_rng(seed)
    value = rng.integers(low, low + 20, 3) + (apart or 0.02) * rng.integers(0, 5, (2, 3))
    text = sentences(made.grid(value, error, x=[1.0, 2.0, 4.0], name="size"))
    places = [f"model={m}, size={x}" for m in ("old", "new") for x in (1, 2, 4)]
    between = re.search(r"It is between .*? \((.*?)\) and .*? \((.*?)\), over 6 points", text)
    assert list(between.groups()) == [places[value.argmin()], places[value.argmax()]]
    is_factor, expected = value.min() > 0.0, {}
    for axis, lines in (("model", value.T), ("size", value)):
        pairs = [pair for line in lines for pair in permutations(line, 2)]
        largest = max(one / other if is_factor else one - other for one, other in pairs)
        sure = np.sqrt(9.0 + 2.0 * np.log(9)) * np.hypot(error, error)  # three errors, and one of nine pairs
        is_sure = any(one - other > sure for one, other in pairs)
        if is_sure and largest >= (1.005 if is_factor else 0.005 * np.ptp(value)):
            expected[axis] = largest
    said = re.findall(r"(model|size) by (?:a factor of )?up to ([\d.]+)( uas)?", text)
    actual = {axis: float(number) * (1e-3 if unit else 1.0) for axis, number, unit in said}
    assert (actual, [*actual]) == (pytest.approx(expected, rel=6e-3), sorted(expected, key=lambda one: -expected[one]))


def test_infinity_and_outputs_that_are_always_missing_are_named(tmp_path):
    @linksweep.experiment(outputs=[linksweep.Output(name, nan=True) for name in "zy"])
    def odd(x: float):
        return {"y": np.inf if x > 2.0 else x, "z": np.nan}

    page = report_page([("s", linksweep.run(odd, tmp_path / "s.zarr", axes={"x": [1.0, 2.0, 3.0]}, pool="serial"))])
    seen = '[1.0, 2.0, "inf"]', '<button type="button">z<', "Not drawn: 1 infinite value of y. <", "Headline results (3"
    for words in (*seen, "It is a finite number at no point that is done.", "It is not a finite number at 1 point."):
        assert words in page


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_differences_from_a_prediction_are_in_errors_and_have_no_unit(factor):
    values, error = factor * np.array(VALUES), 0.1 * factor * np.array(VALUES)
    errors = {"mc_error": 0.6 * error, "catalogue_error": 0.8 * error}
    dataset = grid(values, predicted=np.full((2, 3), 5.0 * factor), **errors)
    actual = residuals(dataset, "width")["width_from_prediction"]
    assert "units" not in actual.attrs
    np.testing.assert_allclose(actual.values, (values - 5.0 * factor) / error, rtol=1e-12)
    assert residuals(grid(values, **errors), "width") is None
    law, indices = linksweep.fit_power_law(dataset, "width", "size"), linksweep.sensitivity(dataset, "width")
    page = report_page([("law", law), ("indices", indices)])
    assert ("exponent" in page, bool(re.search(r'data-label="answer">\w', page))) == (True, True)


@pytest.mark.slow
def test_a_function_has_its_docstring_what_decides_its_outputs_and_its_failures(tmp_path):
    """The variances of 3 a over 1 to 9 and of b over 0, 1, 2 are 60 and 2 / 3; with b = 3 a quarter of points fails."""
    (tmp_path / "chirp.py").write_text(CHIRP)
    axes = {"a": np.arange(1.0, 10.0), "b": [0.0, 1.0, 2.0], "window": ["hann", "box", "none"]}
    pages = []
    for some in (axes, axes | {"b": [0.0, 1.0, 2.0, 3.0]}):
        linksweep.run(f"{tmp_path}/chirp.py:chirp", tmp_path / "c.zarr", axes=some, pool="serial", fresh=True)
        pages.append(report_of([tmp_path / "c.zarr"]))
    page, with_failures = pages
    assert "<h1>Measure the peak of a chirp, which a window lowers</h1>" in page
    assert '<p class="description">The text of &lt;i&gt;all&lt;/i&gt; paragraphs.</p>' in page
    assert re.search(r"<pre[^>]*>Args:\n    a: its rate.</pre>", page)
    peak, early = map(float, re.findall(r"What decides it: a (\d+)[^,<]*%", page))
    assert (peak, early, "it: several together 100 %." in page) == (pytest.approx(98.9, abs=0.6), 100.0, True)
    assert re.search(r"<figcaption>curve, only a=1, a=\d, ", page)
    assert re.findall(r"<li>(27 like ValueError: undefined at )", with_failures)
    counts = map(with_failures.count, ("<summary>Every point that failed (27)</summary>", "more points failed"))
    assert next(counts) > next(counts)
    alone = linksweep.run(lambda a: a, tmp_path / "a.zarr", points={"a": np.arange(20.0)}, pool="serial")
    assert not section("s", alone, 1, 0)["tables"]  # the only parameter decides
    long = linksweep.run(lambda: np.arange(8e4), tmp_path / "l.zarr", pool="serial")
    assert report_page([(name, long) for name in "abc"]).count("would become too large: result") == 1  # the third
    compared = grid(VALUES, published=np.sort(VALUES) * 1.01, published_rounding=0.02 * np.array(VALUES))
    compared["width_published"].attrs["source"] = "a paper"
    rows = [[value for _, value in row] for row in section("s", compared, 1, 0)["comparison"]["rows"]]
    bad = [(row[2] == "reproduced", -abs(row[3] - row[4]) / row[7]) for row in rows]
    assert (bad, bad[0][0], bad[-1][0]) == (sorted(bad), False, True)  # the worst is first
