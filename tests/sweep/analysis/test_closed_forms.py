"""Analysis through the functions of linksweep, on generated results, against SciPy and closed forms."""

import json

import numpy as np
import pytest
import xarray as xr
from hypothesis import assume, example, given, settings, strategies as st
from scipy.linalg import null_space
from scipy.optimize import brentq, curve_fit
from scipy.stats import chi2 as chi2_law, f as f_law, linregress

import linksweep
from tests.sweep.analysis.made import DONE, compare
from tests.tiers import examples

seeds = st.integers(0, 2**32 - 1)
several = settings(max_examples=examples(50))


def results(x, y, errors=None, covariance=None, samples=None, name="n", **attributes):
    variables = {"width": (name, np.asarray(y, dtype=float), {"headline": 1})}
    variables["status"] = name, np.full(len(x), DONE, np.int8)
    if errors is not None:
        variables["width_mc_error"] = name, np.asarray(errors, dtype=float)
    if covariance is not None:
        report = {} if samples is None else {"samples": samples}
        variables[f"width_mc_covariance_{name}"] = (name, f"{name}_other"), covariance, report
    coords = {axis: np.asarray(x, dtype=float) for axis in variables.get(f"width_mc_covariance_{name}", [[name]])[0]}
    return xr.Dataset(variables, coords, {"title": "Widths", **attributes})


def drawn(seed, least=4):
    """Places, values near a power law, and their covariance, of between ``least`` and ``least`` + 5 points."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(least, least + 6))
    x = np.sort(rng.choice(np.geomspace(2.0, 500.0, 60), n, replace=False))
    relative = rng.uniform(0.005, 0.03, n)
    y = 3.0 * x ** rng.uniform(-2.0, 2.0) * np.exp(relative * rng.standard_normal(n))
    mixing = rng.standard_normal((n, 2 * n))
    correlation = mixing @ mixing.T
    correlation = correlation / np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    return rng, x, y, relative * y, correlation * np.outer(relative * y, relative * y)


def factor(samples):
    return 1.0 + 2.0 / (samples - 3.0) if samples >= 5 else np.nan


def best(x, y, covariance, samples):
    """Constant and exponent of the best law, by the diagonal of a covariance that is an estimate, and their errors."""
    design, relative = np.stack([np.ones_like(x), np.log(x)], axis=1), covariance / np.outer(y, y)
    weights = np.linalg.inv(relative if samples is None else np.diag(np.diag(relative)))
    solve = np.linalg.inv(design.T @ weights @ design) @ design.T @ weights
    return solve @ np.log(y), solve @ relative @ solve.T * (1.0 if samples is None else factor(samples))


@several
@given(seeds, st.sampled_from([None, 20, 100]))
def test_a_power_law_through_correlated_points(seed, samples):
    _, x, y, _, covariance = drawn(seed)
    result = linksweep.fit_power_law(results(x, y, covariance=covariance, samples=samples), "width", "n")
    law, spread = best(x, y, covariance, samples)
    at_pivot = np.array([1.0, np.log(result["pivot"].item())])
    height, tilt = np.sqrt(at_pivot @ spread @ at_pivot), np.sqrt(spread[1, 1])
    together = at_pivot @ spread[:, 1] / (height * tilt)
    wanted = {"exponent": law[1], "exponent_error": tilt, "amplitude": np.exp(at_pivot @ law), "correlation": together}
    wanted["amplitude_error"] = height * wanted["amplitude"]
    assert {name: result[name].item() for name in wanted} == pytest.approx(wanted, rel=1e-6, abs=1e-6)
    relative = covariance / np.outer(y, y)
    free = null_space(np.stack([np.ones_like(x), np.log(x)]))  # what no power law explains
    rest = free.T @ np.log(y)
    chi2 = rest @ np.linalg.solve(free.T @ relative @ free, rest)
    dof = len(x) - 2
    assert result["dof"].item() == dof
    if np.isnan(result["chi2"].item()):
        assert samples is not None  # the covariance is of first order, and too much of the errors is shared
        return
    assert result["chi2"].item() == pytest.approx(chi2, rel=1e-6)
    scaled = chi2 if samples is None else chi2 * (samples - dof) / (dof * (samples - 1))
    tail = chi2_law(dof) if samples is None else f_law(dof, samples - dof)
    assert result["p_value"].item() == pytest.approx(tail.sf(scaled), rel=1e-6)


@settings(max_examples=1)
@example(1, 20)
@given(seeds, st.sampled_from([None, 20]))
def test_the_band_of_a_drawn_law_is_that_of_its_errors(seed, samples):
    """In the unit that reads best: the numbers are drawn a thousand times as large."""
    _, x, y, _, covariance = drawn(seed)
    y, covariance = 0.02 * y / y.max(), covariance * (0.02 / y.max()) ** 2
    dataset = results(x, y, covariance=covariance, samples=samples)
    dataset["width"].attrs["units"] = "mas"
    upper = linksweep.plot(dataset, "law").axes[0]
    law, spread = best(x, y, covariance, samples)
    [band] = [one for one in upper.collections if "Bands" in str(one.get_label())]
    corners = band.get_paths()[0].vertices
    for at in (x[0], x[-1]):
        heights = corners[np.isclose(corners[:, 0], at, rtol=1e-9), 1]
        row = np.array([1.0, np.log(at)])
        middle, half = 1000.0 * np.exp(row @ law), np.sqrt(row @ spread @ row)
        assert [heights.min(), heights.max()] == pytest.approx([middle * (1 - half), middle * (1 + half)], rel=1e-6)


@several
@given(seeds)
def test_a_power_law_through_points_without_errors_is_a_linear_regression(seed):
    _, x, y, _, _ = drawn(seed)
    result = linksweep.fit_power_law(results(x, y), "width", "n")
    theirs = linregress(np.log(x), np.log(y))
    assert result["exponent"].item() == pytest.approx(theirs.slope, rel=1e-9)
    assert result["exponent_error"].item() == pytest.approx(theirs.stderr, rel=1e-7)
    scatter = np.sum((np.log(y) - theirs.intercept - theirs.slope * np.log(x)) ** 2) / (len(x) - 2)
    assert result["amplitude_error"].item() / result["amplitude"].item() == pytest.approx(np.sqrt(scatter / len(x)))
    assert np.isnan(result["chi2"].item())
    assert linksweep.fit_power_law(results(x[:2], y[:2]), "width", "n")["exponent_error"].item() == 0.0  # no scatter
    exact = results(x := np.array([1.0, 4.0, 9.0]), 4000.0 * x**-0.5)  # its scatter is that of rounding
    assert linksweep.fit_power_law(exact, "width", "n", -0.5)["conclusion"].item() == "as expected"


def level(x, plateau, size, rate):
    return np.sqrt(plateau**2 + size * np.exp(-rate * x))


def levelled(seed, quality=1.0):
    """Points near a law that levels off within them, at places from anywhere, with the start of a fit."""
    rng = np.random.default_rng(seed)
    length, first = rng.uniform(5.0, 12.0), rng.uniform(0.0, 3.0)
    x = first + length * np.linspace(0.0, 1.0, int(rng.integers(9, 15)))
    rate = rng.uniform(2.0, 4.0) / length
    truth = rng.uniform(0.4, 2.0), np.exp(rate * first) * rng.uniform(2.0, 5.0), rate
    relative = rng.uniform(4e-5, 8e-5, len(x))  # so small that the first order is all
    y = level(x, *truth) * np.exp(quality * relative * rng.standard_normal(len(x)))
    return x, y, relative, truth


def derived(x, fall, plateau, size, rate):
    def slope(at):
        part = size * np.exp(-rate * at)
        return 1.0 - np.exp(-0.5 * rate * part / (plateau**2 + part))

    reach = 60.0 / rate
    return slope(x[-1]), brentq(lambda at: slope(at) - fall, x[0] - reach, x[-1] + reach)


@several
@given(seeds, st.sampled_from([0.5, 1.0, 4.0]))
def test_the_levelling_law_is_that_of_scipy_with_its_errors(seed, quality):
    x, y, relative, truth = levelled(seed, quality)
    fall = 0.2 * truth[2]
    result = linksweep.fit_levelling(results(x, y, relative * y), "width", "n", fall=fall)
    options = {"p0": truth, "sigma": relative, "absolute_sigma": True, "xtol": 1e-14, "ftol": 1e-14}
    law, spread = curve_fit(lambda at, *law: np.log(level(at, *law)), x, np.log(y), **options)
    # else it falls by less everywhere, or the best law has no plateau, which a root of a square cannot say
    assume(law[2] > 2.2 * fall and abs(law[0]) > 0.1 * truth[0])
    chi2 = float(np.sum(((np.log(y) - np.log(level(x, *law))) / relative) ** 2))
    dof = len(x) - 3
    spread = spread * max(1.0, chi2 / dof)
    assert result["chi2"].item() == pytest.approx(chi2, rel=1e-4)
    assert (result["dof"].item(), result["points"].item()) == (dof, len(x))
    assert result["p_value"].item() == pytest.approx(chi2_law(dof).sf(chi2), rel=1e-3, abs=1e-12)
    of_law = {"plateau": lambda at: abs(at[0]), "rate": lambda at: at[2]}
    of_law |= {n: lambda at, k=k: derived(x, fall, *at)[k] for k, n in enumerate(("end_fall", "limit"))}
    for name, function in of_law.items():
        value, error = function(law), delta(function, law, spread, 1e-5)
        assert result[name].item() == pytest.approx(value, abs=0.01 * error), name
        assert result[f"{name}_error"].item() == pytest.approx(error, rel=0.02), name
    without = linksweep.fit_levelling(results(x, y), "width", "n", fall=fall)  # errors come from the scatter
    scatter = curve_fit(lambda at, *law: np.log(level(at, *law)), x, np.log(y), p0=law)[1]
    assert without["rate_error"].item() == pytest.approx(np.sqrt(scatter[2, 2]), rel=0.02)
    of_samples = results(x, y, covariance=np.diag((relative * y) ** 2), samples=20)
    of_samples = linksweep.fit_levelling(of_samples, "width", "n", fall=fall)
    assert of_samples["rate_error"].item() == pytest.approx(result["rate_error"].item() * np.sqrt(factor(20)), rel=1e-3)


@settings(max_examples=examples(25))
@given(seeds, st.floats(1.02, 1.9))
def test_a_law_too_slow_for_the_fall_falls_by_less_everywhere(seed, times):
    """Its logarithm falls by at most rate/2 a unit, where the plateau does not count yet."""
    x, _, relative, truth = levelled(seed)
    y = level(x, *truth)
    for fall, meets in ((-np.expm1(-0.5 * times * truth[2]), False), (-np.expm1(-0.5 / times * truth[2]), True)):
        result = linksweep.fit_levelling(results(x, y, relative * y), "width", "n", fall=fall)
        if meets:
            assert result["limit"].item() == pytest.approx(derived(x, fall, *truth)[1], rel=1e-3)
        else:
            assert (result["limit"].item(), result["conclusion"].item()) == (-np.inf, "falls by less everywhere")
    rising = linksweep.fit_levelling(results(x, y[::-1], relative * y), "width", "n")
    assert np.isnan(rising["plateau"].item())  # which is before the points, not beyond them


def delta(function, values, covariance, step=1e-6):
    steps = step * np.diag(np.abs(values))
    gradient = np.array([(function(values + s) - function(values - s)) / (2.0 * s.sum()) for s in steps])
    return np.sqrt(gradient @ covariance @ gradient)


@several
@example(1, 0.5, True, 5, True)  # the fewest samples whose scatter gives an error
@example(1, 0.5, True, 4, False)
@given(seeds, st.floats(0.01, 0.99), st.booleans(), st.sampled_from([None, 4, 5, 20]), st.booleans())
def test_a_value_between_points_and_the_place_of_a_value(seed, share, shared, samples, magnitudes):
    _, x, y, errors, covariance = drawn(seed)
    y, (to, back) = np.sort(y), ((np.positive, np.positive) if magnitudes else (np.log, np.exp))
    errors, spread = (None, covariance) if shared else (errors, np.diag(errors**2))
    more = (factor(samples) if samples is not None else 1.0) if shared else 1.0
    dataset = results(x, y, errors, covariance if shared else None, samples)
    dataset = dataset.assign_coords(n=("n", x, {"units": "mag" if magnitudes else ""}))
    at = float(back(np.interp(share, [0.0, 1.0], to(x[[0, -1]]))))

    def between(values):
        return np.exp(np.interp(to(at), to(x), np.log(values)))

    result = linksweep.interpolate(dataset, "width", over="n", at=at)
    assert result["width"].item() == pytest.approx(between(y), rel=1e-9)
    wanted = delta(between, y, spread) * np.sqrt(more)
    assert result["width_mc_error"].item() == pytest.approx(wanted, rel=1e-5, nan_ok=True)
    nearest = linksweep.find(dataset, f"width < {0.5 * float(y[0])!r}", over="n")["nearest_error"].item()
    assert nearest == pytest.approx(np.sqrt(spread[0, 0] * more), nan_ok=True)
    limit = float(np.exp(np.interp(share, [0.0, 1.0], np.log(y[[0, -1]]))))

    def place(values):
        return back(np.interp(np.log(limit), np.log(values), to(x)))

    crossing = linksweep.find(dataset, f"width < {limit!r}", over="n")
    assert crossing["first"].item() == crossing["last"].item() == pytest.approx(place(y), rel=1e-9)
    # Half as far on the axis as the line is within two of its errors of the limit, on the side where that is farther.
    z, at = to(x), to(crossing["first"].item())
    far = np.ptp(z) * np.geomspace(1e-9, 3.0, 12001)[:, None]
    reaches = []
    for line in (at + far, at - far):
        i = np.clip(np.searchsorted(z, line) - 1, 0, len(x) - 2)
        share = (line - z[i]) / (z[i + 1] - z[i])
        weights = np.where(np.arange(len(x)) == i, 1.0 - share, 0.0) + np.where(np.arange(len(x)) == i + 1, share, 0.0)
        errors = np.sqrt(np.einsum("ki,ij,kj->k", weights, spread / np.outer(y, y), weights) * more)
        outside = np.flatnonzero(~(np.abs(weights @ np.log(y) - np.log(limit)) < 2.0 * errors))
        reaches.append(float(far[outside[0], 0]) if outside.size and not np.isnan(errors).any() else np.nan)
    first, error = crossing["first"].item(), crossing["first_error"].item()
    wanted = np.maximum(back(at + reaches[0]) - first, first - back(at - reaches[1])) / 2.0
    is_far = np.isnan(wanted) and 2.0 * error > first - back(at - 3.0 * np.ptp(z))
    assert is_far or error == pytest.approx(wanted, rel=2e-3 * (1.0 + np.nan_to_num(max(reaches))), nan_ok=True)


@several
@given(seeds, st.sampled_from([None, 20, 200]))
def test_a_ratio_of_two_points_and_claims_of_ratios_and_slopes(seed, samples):
    _, x, y, errors, covariance = drawn(seed)
    whole = results(x, y, None, covariance, samples).assign(width_mc_error=("n", errors))
    more = 1.0 if samples is None else factor(samples)
    far = results(x, 2.0**900 * y, 2.0**900 * errors), np.diag(errors**2)
    for dataset, spread in (far, (whole, covariance * more)):
        result = linksweep.ratio(dataset, "width", "n", of=x[0], to=x[-1])
        assert result["ratio"].item() == pytest.approx(y[0] / y[-1], rel=1e-12)
        wanted = delta(lambda values: values[0] / values[-1], y, spread)
        assert result["ratio_error"].item() == pytest.approx(wanted, rel=1e-5)
        assert linksweep.ratio(dataset, "width", "n", of=x[0], to=x[0])["ratio_error"].item() == 0.0
    where = {"variable": "width", "of": {"n": float(x[0])}, "to": {"n": float(x[-1])}}
    slope = {"published": "-1.0", "slope": {"variable": "width", "over": "n"}}
    claims = [{"text": "a", "source": "b"} | one for one in ({"published": "1", "ratio": where}, slope)]
    quotient, slope = compare(whole.assign_attrs(claims=json.dumps(claims)))
    fit = linksweep.fit_power_law(whole, "width", "n")
    assert (quotient.value, quotient.mc_error) == pytest.approx((y[0] / y[-1], wanted), rel=1e-5)
    assert (slope.value, slope.mc_error) == pytest.approx((fit["exponent"].item(), fit["exponent_error"].item()))
    for one, rounding in ((quotient, 0.5), (slope, 0.05)):
        assert one.allowance == pytest.approx(rounding + 3.0 * one.mc_error)
        assert one.detectable == pytest.approx(rounding + 4.6449 * one.mc_error)


def table(columns, y):
    coords = {name: ("point", np.asarray(values)) for name, values in columns.items()}
    variables = {"y": ("point", np.asarray(y, dtype=float), {"headline": 1})}
    variables["status"] = "point", np.full(len(y), DONE, np.int8)
    attributes = {"title": "", "function": "f", "point_table": json.dumps({"parameters": list(columns)})}
    return xr.Dataset(variables, coords, attributes)


def as_design(made, **ranges):
    report = {"parameters": list(ranges), "design": "sobol", "n": made.sizes["point"], "ranges": ranges}
    return made.assign_attrs(point_table=json.dumps(report))


@several
@given(seeds, st.integers(1, 6), st.integers(64, 150))
def test_a_function_of_the_ranks_alone_is_all_that_decides(seed, waves, n):
    """Waves over ranks of given points, and over the middles of the parts of a design's range, are fitted exactly."""
    rng = np.random.default_rng(seed)
    x, k = np.round(rng.uniform(0.0, 5.0, n), 1), rng.integers(1, 41, n)
    ranks = np.array([(np.sum(x < one) + 0.5 * np.sum(x == one)) / n for one in x])
    for column, place, ranges in ((x, ranks, None), (k, (k - 0.5) / 40.0, {"x": [1, 40], "other": [0, 1]})):
        made = table({"x": column, "other": rng.random(n), "copy": 2.0 * column}, np.cos(np.pi * waves * place))
        result = linksweep.sensitivity(as_design(made, **ranges) if ranges else made)
        assert result["first"].values[0] == pytest.approx(1.0, abs=1e-9)
        assert result["first"].values[1] < 0.9
        assert ranges or "x and copy go together in these points" in result.attrs["notes"]


@several
@given(seeds, st.integers(2, 9), st.integers(40, 80))
def test_groups_explain_the_adjusted_share(seed, groups, n):
    rng = np.random.default_rng(seed)
    kind = np.concatenate([np.arange(groups), rng.integers(0, groups, n - groups)])
    y = kind + rng.standard_normal(n)
    names = np.array([f"k{k}" for k in kind])
    result = linksweep.sensitivity(table({"kind": names, "x": rng.random(n)}, y))
    inside = sum(np.sum((y[kind == k] - y[kind == k].mean()) ** 2) for k in range(groups))
    share = 1.0 - inside / np.sum((y - y.mean()) ** 2) * (n - 1) / (n - groups)
    assert result["first"].values[0] == pytest.approx(share, abs=1e-9)
    even = as_design(table({"kind": names, "x": rng.random(n)}, y), kind={"values": ["a"]}, x=[0, 1])
    chance = inside / np.sum((y - y.mean()) ** 2) * (groups - 1) / (n - groups)
    spread = linksweep.sensitivity(even)
    assert spread["first"].values[0] == pytest.approx(share + 0.5 * chance, abs=1e-9)
    assert spread["first_error"].values[0] == result["first_error"].values[0]  # both have the scatter of this chance


@several
@given(seeds, st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(2, 4)))
def test_indices_of_a_grid_without_the_part_of_the_noise(seed, sizes):
    """Against expectations written out: the variance of a mean of independent errors is a sum of theirs."""
    rng = np.random.default_rng(seed)
    values, errors = 3.0 * rng.standard_normal(sizes), rng.uniform(0.1, 1.0, sizes)
    axes = dict(zip("abc", map(np.arange, sizes), strict=True))
    variables = {"y": (tuple(axes), values, {"headline": 1}), "y_mc_error": (tuple(axes), errors)}
    variables["status"] = tuple(axes), np.full(sizes, DONE, np.int8)
    result = linksweep.sensitivity(xr.Dataset(variables, axes, {"title": "", "function": "f"}))

    def variance(kept):
        others = tuple(k for k in range(3) if k not in kept)
        means = values.mean(axis=others)
        noise = (errors**2).sum(axis=others) / np.prod([sizes[k] for k in others], dtype=float) ** 2
        return means.var() - noise.mean() * (1.0 - 1.0 / means.size)

    whole = variance((0, 1, 2))
    if whole <= 0.0:
        assert np.isnan(result["first"].values).all()
        return
    assert result["first"].values == pytest.approx([variance((k,)) / whole for k in range(3)], abs=1e-9)
    rest = [variance(tuple(j for j in range(3) if j != k)) for k in range(3)]
    assert result["total"].values == pytest.approx([1.0 - one / whole for one in rest], abs=1e-9)
    assert not np.any(result["first_error"].values <= 0.0)  # NaN where noise hides the variance in some draws
