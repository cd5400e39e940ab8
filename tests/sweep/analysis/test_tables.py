"""What tables and sentences show of results: exact integers and gaps, components, units that read well."""

import json
import math
import re

import numpy as np
import xarray as xr
from astropy.table import Table
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep.sweep.analysis.quantity import select
from tests.sweep.analysis.made import DONE, EXCLUDED, RUNNING, N, Result, answers, compare, grid, shown, text_of
from tests.tiers import examples

LARGE = 2**60
EXPECTED = [None if a % 3 == 0 else a for a in range(1, 11)]
EXACT = [None if a is None else LARGE + a for a in EXPECTED]
STARTS, STEPS = [0.0, 1.0, -3e-7, 59000.0, 2460000.0, 1420405751.768, 2.0**30], [0.1, 1.0, 1.0 / 3.0, 0.04, 1e-4]


def large(a: int):
    if a % 3 == 0:
        raise ValueError("no")
    return {"k": LARGE + a, "small": a, "line": np.arange(2) + LARGE + a}


def test_integers_are_exact_beside_gaps_in_tables_and_in_the_dataset(tmp_path, sweep):
    store = tmp_path / "large.zarr"
    linksweep.run(large, store, axes={"a": range(1, 11)}, pool="serial")
    text = shown("show", store)
    assert (str(LARGE + 1) in text, str(np.iinfo(np.int64).min) in text) == (True, False)
    assert ["3", "failed"] in [line.split() for line in text.splitlines()]
    rows = json.loads(shown("show", store, "--json"))["rows"]
    assert [row["small"] for row in rows] == EXPECTED
    assert [row["k"] for row in rows] == EXACT
    assert (rows[1]["line"], rows[2]["line"]) == ([LARGE + 2, LARGE + 3], [None, None])
    csv = [line.split(",")[1:3] for line in shown("show", store, "--format", "csv").splitlines()[1:]]
    assert [cells[0] for cells in csv] == ["" if k is None else str(k) for k in EXACT]
    assert [float(cells[1]) if cells[1] else None for cells in csv] == EXPECTED
    ecsv = Table.read(shown("show", store, "--format", "ecsv"), format="ascii.ecsv")
    assert (ecsv["k"].tolist(), ecsv["small"].tolist()) == (EXACT, EXPECTED)
    result = linksweep.open(store)
    assert [None if k != k else k for k in result.k.values] == EXACT  # noqa: PLR0124 (NaN)
    assert result.small.dtype == float
    for command in ("plot", "fit"):
        assert "no numbers to draw or to fit" in sweep(command, store, "--over", "a", "--variable", "k", code=2)[2]
    # an integer beyond those of floats chooses its own point
    linksweep.run(large, tmp_path / "s.zarr", axes={"a": [2**54, 2**54 + 1]}, pool="serial")
    (row,) = json.loads(shown("show", tmp_path / "s.zarr", "--at", f"a={2**54 + 1}", "--json"))["rows"]
    assert row["small"] == 2**54 + 1


def everything(dataset):
    """All that is said and computed of results."""
    results = [linksweep.find(dataset, one, "n") for one in ("width > 1.5", "shift > 0.2")]
    results += [
        linksweep.fit_power_law(dataset, "width", "n"),
        linksweep.ratio(dataset, "shift", "model", "old", "new"),
    ]
    numbers = [repr(one.transpose(*sorted(one.dims)).to_dict()) for one in results]
    return [one.sentences for one in answers(dataset)], numbers, text_of(dataset), sorted(map(repr, compare(dataset)))


@given(st.integers(0, 2**32 - 1), st.sampled_from([[DONE, EXCLUDED], [DONE]]))
@settings(max_examples=examples(20, 2))
def test_nothing_depends_on_the_order_of_dimensions_nor_an_answer_on_what_is_excluded(seed, codes):
    rng = np.random.default_rng(seed)
    status, axes = rng.choice(codes, (2, 5)).astype(np.int8), ("model", "n")
    status[:, :2] = DONE  # else a line may have too few points for a law
    whole = grid(1.0 + rng.random((2, 5)), 0.1, status=status, published={(1, 2): "1.5", (0, 4): "1.2"})
    for name, values in ("shift", rng.standard_normal((2, 5, 3))), ("shift_mc_error", rng.random((2, 5, 3))):
        whole[name] = (*axes, "component"), values
    whole["condition_number"] = axes, 10.0 ** rng.uniform(0.0, 6.0, (2, 5))
    whole = whole.where(whole["status"] == DONE).assign(status=(axes, status)).assign_coords(component=["x", "y", "z"])
    whole = whole.assign_attrs(points=np.sum(status == DONE), complete=0)
    turned = {name: one.transpose(*one.dims[::-1]) for name, one in whole.items() if name != "status"}
    assert everything(whole.assign(turned)) == everything(whole)
    assert "its run did not end" in text_of(whole)
    wide = whole.reindex(n=[*N, 999.0])
    wide["status"] = wide["status"].fillna(EXCLUDED).astype(np.int8)
    assert everything(wide)[0] == everything(whole)[0]


@given(st.sampled_from(STARTS), st.sampled_from(STEPS), st.sampled_from([0.0, 0.5]), st.integers(0, 99))
@settings(max_examples=examples(100))
def test_a_value_of_an_axis_is_shown_so_that_it_can_be_told_from_others_and_chosen(start, step, unevenness, seed):
    places = np.arange(8) + unevenness * np.random.default_rng(seed).random(8)
    x = (start + step * places).tolist()
    dataset = grid(1.0, x=x)
    texts = [cells[1] for line in text_of(dataset).splitlines() if (cells := line.split())[:1] == ["old"]]
    assert len(set(texts)) == len(x)
    assert np.abs(np.array(texts, dtype=float) - x).max() <= step / 50.0
    assert max(map(len, texts)) <= (18 if unevenness else len(f"{start:.3f}") + 7)
    for text, value in zip(texts, x, strict=True):
        assert all(select(dataset, {"n": one})["n"].item() == value for one in (text, f"{value:.17g}"))


def lit(jd: float, w: float = 1.0):
    return {"flux": 2.0 + math.sin(w * (jd - 2460000.0)), "freq": 1420405751.768 + w * (jd - 2460000.0)}


def test_days_are_told_apart_wherever_they_are_shown(tmp_path):
    store, jd = tmp_path / "lc.zarr", [2460000.0 + 0.1 * i for i in range(11)]
    linksweep.run(lit, store, axes={"jd": jd, "w": [1.0, 2.0]}, pool="serial")
    assert "2.1" in shown("show", store, "--at", "w=1", "--at", "jd=2460000.1")
    result = repr(linksweep.answer(linksweep.find(linksweep.open(store), "freq > 1420405752", over="jd")))
    assert re.findall(r"from (\S+)", result) == ["2460000.23", "2460000.12"]
    assert "freq > 1420405752 along" in result
    assert "at 2460001 is nearest" in shown("find", store, "--over", "jd", "--where", "flux > 9")
    assert "2460000.50" in shown("fit", store, "--over", "jd", "--variable", "flux").split()
    assert "(jd=2460000.8, w=2)" in " ".join(answers(linksweep.open(store))[0].sentences)
    curve = {"experiment": lambda rng, x: xr.DataArray(x * rng.random(3), {"jd": jd[:3]}, name="y")}
    linksweep.run(curve | {"axes": {"x": [1.0]}, "sampling": {"n_sim": 9}}, tmp_path / "c", pool="serial")
    assert "x y_mean y_std 1" in " ".join(shown("show", tmp_path / "c", "--at", f"jd={jd[1]}").split())


def test_a_prediction_with_its_bias_and_a_published_number_are_shown_with_the_difference():
    dataset = grid(0.6, 0.003, published={(0, 0): "0.5"})
    axes = dataset["width"].dims
    parts = {"width_rms_predicted": 0.5, "width_predicted": 0.4}  # of the errors alone
    dataset = dataset.assign({name: (axes, np.full((2, 5), x), {"units": "mas"}) for name, x in parts.items()})
    first = next(line for line in text_of(dataset).splitlines() if line.split()[:1] == ["old"])
    assert first.split()[2:] == ["0.6000", "±", "0.0030", "0.5000", "0.5", "+20.0", "%"]
    kinds = grid(0.66123).assign(a=(axes, np.full((2, 5), 0.0027)), b=(axes, np.broadcast_to(0.004 * N, (2, 5))))
    kinds["width"].attrs["errors"] = "a b"
    assert "300 0.6612 0.0027 1.2" in " ".join(text_of(kinds).split())  # digits of the least error, where one changes
    text = text_of(grid(28.0, published={(0, 0): "28"}))  # what is met exactly is a sentence and no column
    assert ("width: all published values are met exactly" in text, "difference" in text) == (True, False)
    both = dataset.assign({name.replace("width", "size"): part for name, part in dataset.drop_vars("status").items()})
    assert Result(both).tables()[0].fitting(70)[1] == "size, size predicted, size published, size difference"
    for place, is_shown in ((3, True), (299, False)):  # a table has the first 200 points
        status = np.where(np.arange(300) == place, RUNNING, DONE).reshape(2, 150)
        many = grid(1.0, x=np.arange(150.0), status=status).assign(n_sim_done=(axes, np.full((2, 150), 7)))
        assert ("realisations" in text_of(many).partition("\n\n")[0]) == is_shown


def test_each_component_and_a_bad_condition_are_shown_in_80_columns():
    """The twelve masers: the mean 1.05 hides 0.11, 1.59 and 0.89, of which two have a correlation of 0.999."""
    sigma, correlation = np.array([0.11, 1.59, 0.89]), np.eye(3)
    correlation[1, 2] = correlation[2, 1] = -0.999
    axes, names = ("n_obj", "component"), ["omega_x", "omega_y", "omega_z"]
    variables = {"sigma": (axes, [sigma]), "sigma_mc_error": (axes, [0.01 * sigma])}
    variables |= {"correlation": ((*axes, "component_other"), [correlation]), "condition_number": ("n_obj", [1999.0])}
    variables |= {"n_sim_done": ("n_obj", [1000]), "status": ("n_obj", np.array([1], dtype=np.int8))}
    units = {"component_unit": ("component", ["mas / yr"] * 3)}
    masers = xr.Dataset(variables, {"n_obj": [12], "component": names, "component_other": names} | units)
    text = text_of(masers)
    shown = [line.split() for line in text.splitlines() if line.startswith("omega_") and "yr" in line]
    assert shown == [[f"omega_{axis}", f"{number:#.3g}", "mas/yr"] for axis, number in zip("xyz", sigma, strict=True)]
    words = "sigma, n_obj=12: condition number 2e+03, largest correlation -0.999 (omega_y, omega_z)"
    assert words in " ".join(text.split())
    better = [masers.assign(condition_number=("n_obj", [n])).assign_coords(n_obj=[n]) for n in (3, 4, 5)]
    assert words in " ".join(text_of(xr.concat([*better, masers], "n_obj")).split())  # of the three worst
    assert max(map(len, text.splitlines()[:4])) <= 80
    warned = "at 1 point the condition number is up to 2e+03"
    assert (warned in text, warned in text_of(masers.assign(condition_number=("n_obj", [3.0])))) == (True, False)
    assert "omega_x" not in text_of(masers.drop_vars(["sigma_mc_error"]))
    alone = masers.isel(component=0).assign({n: (("n_obj", "axis"), [sigma]) for n in ("glide", "glide_mc_error")})
    text = text_of(alone.assign_coords(axis=["x", "y", "z"]))  # whose correlations nobody knows
    assert ("glide, n_obj=12: condition number" in text, "correlation" in text) == (True, False)
    masers["formal"], masers["sigma"].attrs["errors"] = masers["sigma_mc_error"], "formal"
    assert "; formal 0.00110 to 0.0159." in " ".join(answers(masers)[0].sentences)  # of all components
