"""Every number of a link of drawn tables against least squares with full matrices, without elimination."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag

import linksweep
from linksweep.core.frames import MAS
from linksweep.core.tie.astrometry import PAIRS, by_errors, joined, propagated
from linksweep.core.unknowns import Objects, parse_unknowns
from linksweep.sweep.result import Result
from tests.core.tie.made import POSITION, gaia, noise, only, seen_by_satellite, stars
from tests.tiers import few, slow

EPSILON, OMEGA = np.array([0.4, -0.3, 0.9]) * MAS, np.array([-0.2, 0.1, 0.3]) * MAS
KINDS_OF_ROWS = [["five"], ["five", "position"], ["motion", "position", "ra", "pmdec"]]
PRESENT = {"five": np.arange(5) >= 0, "position": POSITION, "motion": np.arange(5) > 2}
PRESENT |= {"ra": np.arange(5) == 0, "pmdec": np.arange(5) == 4}
KINDS = "formal,scaled,jackknife,sandwich,cells"
SEEDS = [1, *map(slow, (2, 4))]
WAYS = [("covariance", "huber:1.5"), ("covariance", "median:1.5"), ("variance", "none"), ("equal", "huber:1.5")]
WAYS += [("covariance", "none"), ("variance", "huber:1.5"), ("equal", "none")]


def drawn_tables(folder, seed, n=12, free=2, scale=1.0, far=(), coarse=(), calibrators=("",)):
    """Write two tables; the last ``free`` sources have positions alone, ``far`` are off by 30 mas, ``coarse`` by 15."""
    rng = np.random.default_rng(seed)
    epoch = 2016.0 + rng.uniform(-3.0, 3.0, n)
    made = replace(stars(n, seed, pm=20.0), radial_velocity=np.zeros(n), epoch=epoch)
    alone = [made.taken(np.array([s])) for s in range(n)]
    turn = [EPSILON + OMEGA * (year - 2016.0) for year in epoch]
    seen = [seen_by_satellite(one, by, OMEGA) for one, by in zip(alone, turn, strict=True)]
    ours = replace(made, values=np.concatenate(seen, axis=1) + scale * noise(rng, made))
    ours = only(ours, (np.arange(5)[:, None] < 2) | (np.arange(n) < n - free))
    kinds = [["position"] * 3 if s >= n - free else KINDS_OF_ROWS[s % 3] for s in range(n)]
    kinds = [(s, kind) for s in range(n) for kind in kinds[s]]
    kinds = [kinds[k] for k in rng.permutation(len(kinds))]  # rows of a source are apart, and no column is sorted
    source, size = np.array([s for s, _ in kinds]), len(kinds)
    rows = stars(size, seed + 1000)
    is_coarse, offset = np.isin(source, coarse), 30.0 * np.isin(source, far)
    rows = replace(rows, errors=np.where(is_coarse, 150.0, 1.0) * rows.errors, radial_velocity=np.zeros(size))
    rows = replace(rows, epoch=epoch[source] + rng.uniform(-12.0, 12.0, size))
    truth = propagated(made.values[:, source], None, epoch[source], rows.epoch)
    values = truth + scale * noise(rng, rows) + np.where(is_coarse, 15.0, offset) * MAS
    rows = replace(rows, values=values, errors=np.where([PRESENT[kind] for _, kind in kinds], rows.errors.T, np.nan).T)
    names = np.where(np.isfinite(rows.errors[0]), rng.choice(calibrators, size), "")
    shared = np.where(names == "", 0.0, rng.uniform(0.1, 1.0, size))
    columns = {"calibrator": names, "calibrator_error": np.where(names == "", 0.5, shared)} if any(calibrators) else {}
    paths = {"satellite": gaia(folder / "satellite.fits", ours)}
    paths["reference"] = gaia(folder / "reference.fits", rows, source_id=source + 10**17, **columns)
    return SimpleNamespace(**paths, ours=ours, rows=rows, source=source, names=names, shared=shared)


def turned(ra, dec):
    sine, cosine = np.sin(ra), np.cos(ra)
    return np.array([[-cosine * np.sin(dec), -sine * np.sin(dec), np.cos(dec)], [sine, -cosine, 0.0]])


def motion(years):
    """Derivatives of five parameters after some years by those at the start, accelerations and their derivatives."""
    partials = np.eye(5, 9)
    for c in (0, 1):
        partials[c, [c + 3, c + 5, c + 7]] = years, years**2 / 2.0, years**3 / 6.0
        partials[c + 3, [c + 5, c + 7]] = years, years**2 / 2.0
    return partials


def pieces_of(tables, difference, epoch=2016.0):
    """Yield y, A, B, and the covariance of e, of y = A x + B z + e (mas) of each source; the satellite lacks z."""
    ours, rows = tables.ours, tables.rows
    covariance = np.zeros((len(ours), 9, 9))
    covariance[:, :5, :5] = ours.covariance()
    covariance = getattr(tables, "covariance", covariance) / MAS**2
    for s in range(len(ours)):
        r, design = turned(*ours.values[:2, s]), np.zeros((9, 6))
        design[:2, :3], design[:2, 3:], design[3:5, 3:] = r, (ours.epoch[s] - epoch) * r, r
        seen = [(k, np.flatnonzero(np.isfinite(rows.errors[:, k]))) for k in np.flatnonzero(tables.source == s)]
        m = np.concatenate([motion(rows.epoch[k] - ours.epoch[s])[at] for k, at in seen])
        b = m[:, np.flatnonzero(np.isnan(ours.errors[:, s]))]
        v = block_diag(*(rows.covariance()[k][np.ix_(at, at)] / MAS**2 for k, at in seen))
        y, b = np.concatenate([difference[k, at] for k, at in seen]), b[:, np.any(b != 0.0, axis=0)]  # not by parallax
        observed = [(k, parameter) for k, at in seen for parameter in at]
        yield SimpleNamespace(y=y, a=m @ design, b=b, m=m, d=v + m @ covariance[s] @ m.T, observed=observed)


def least_squares(tables, difference, weights, factor, resamples=2):
    """Everything of a solution for orientation and spin from full matrices, weights of sources times their factors."""
    pieces, n, rng = list(pieces_of(tables, difference)), len(tables.ours), np.random.default_rng(1)
    plain = []
    for one in pieces:
        d, b = one.d, one.b
        g = {"covariance": np.linalg.inv(d), "variance": np.diag(1.0 / np.diag(d)), "equal": np.eye(len(d))}[weights]
        plain.append(g - g @ b @ np.linalg.pinv(b.T @ g @ b) @ b.T @ g if b.size else g)
    count = [len(one.d) - one.b.shape[1] for one in pieces]
    w = [g * f for g, f in zip(plain, factor, strict=True)]
    normals = np.array([one.a.T @ g @ one.a for one, g in zip(pieces, w, strict=True)])
    right = np.array([one.a.T @ g @ one.y for one, g in zip(pieces, w, strict=True)])
    total, used = normals.sum(axis=0), np.flatnonzero(factor > 0.0)
    inverse = np.linalg.inv(total)
    x = inverse @ right.sum(axis=0)
    big_a, big_w, big_d = np.concatenate([one.a for one in pieces]), block_diag(*w), block_diag(*(o.d for o in pieces))
    residual = np.concatenate([one.y for one in pieces]) - big_a @ x
    to_x = inverse @ big_a.T @ big_w
    hat = np.eye(len(residual)) - big_a @ to_x
    of_residuals = hat @ big_d @ hat.T
    places = [slice(*edge) for edge in pairwise(np.cumsum([0, *(len(one.y) for one in pieces)]))]

    def solution(left):
        return np.linalg.solve(normals[left].sum(axis=0), right[left].sum(axis=0))

    def scatter(solutions):
        return (len(solutions) - 1) * np.cov(np.transpose(solutions), bias=True)

    alone = np.full((n, 6), np.nan)
    alone[used] = [solution(np.arange(n) != s) for s in used]
    ra, dec = tables.ours.values[:2]  # cells are six bands of equal height in sin(dec), each of twelve steps in ra
    cell = 12 * np.floor(3.0 * (np.sin(dec) + 1.0)) + np.floor(ra * 6.0 / np.pi)
    scores = np.array([one.a.T @ g @ residual[p] for one, g, p in zip(pieces, w, places, strict=True)])[used]
    formal = to_x @ big_d @ to_x.T
    chi2, expected = residual @ big_w @ residual, np.trace(big_w @ of_residuals)
    dof = sum(c for c, f in zip(count, factor, strict=True) if f > 0.0) - 6
    dense = {"x": x, "chi2": chi2, "expected": expected, "dof": dof, "formal": formal, "count": np.array(count)}
    dense |= {"scaled": formal * chi2 / expected, "jackknife": scatter(alone[used])}
    dense["cells"] = scatter([solution(cell != one) for one in np.unique(cell[used])])
    dense["bootstrap"] = np.cov(np.transpose([solution(rng.integers(0, n, n)) for _ in range(resamples)]))
    dense["sandwich"] = inverse @ (scores.T @ scores) @ inverse * len(used) / (len(used) - 1)
    dense |= {"without": alone, "cook": np.einsum("sk,kl,sl->s", alone - x, total, alone - x) / 6.0}
    each = list(zip(plain, places, strict=True))
    dense["discrepancy"] = np.array([residual[p] @ g @ residual[p] for g, p in each])
    dense["average"] = np.array([np.trace(g @ one.d) for one, g in zip(pieces, plain, strict=True)])
    dense["discrepancy_expected"] = np.array([np.trace(g @ of_residuals[p, p]) for g, p in each])
    blocks = slice(0, 3), slice(3, 6)
    dense["share"] = np.array([[np.trace(np.linalg.inv(total[b, b]) @ m[b, b]) / 3.0 for b in blocks] for m in normals])
    return SimpleNamespace(**dense, residual=residual, error=np.sqrt(np.diag(big_d)))


def linked(tables, **options):
    options = {"positions": "mean", "epoch": 2016.0, "accept_misfit": True} | options
    return linksweep.tie(tables.satellite, tables.reference, "orientation,spin", **options)


def compare(link, tables, weights, sign=1.0):
    resamples = 1000 if "bootstrap" in link.error_kind else 2
    result = least_squares(tables, sign * link.difference.values, weights, link.weight_factor.values, resamples)
    kept, order = link.weight_factor.values > 0.0, np.argsort(tables.source, kind="stable")
    for kind in map(str, link.error_kind.values):
        expected, got = getattr(result, kind), link.covariances.sel(error_kind=kind).values
        rtol = 0.2 if kind == "bootstrap" else 5e-5  # of other random numbers
        np.testing.assert_allclose(link.errors.sel(error_kind=kind), np.sqrt(np.diag(expected)), rtol=rtol)
        if kind != "bootstrap":
            np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max(), err_msg=kind)
    np.testing.assert_array_equal(link.n_observations, result.count)
    np.testing.assert_allclose(link.share.values.sum(axis=0), 1.0)
    observed = {name: link[name].values[order] for name in ("residual", "difference_error")}
    observed = {name: values[np.isfinite(values)] for name, values in observed.items()}
    for got, expected, rtol, atol in (
        (sign * link.estimate, result.x, 2e-5, 1e-6),
        (link.chi2, result.chi2, 2e-5, 0.0),
        (link.chi2_expected, result.expected, 2e-5, 0.0),
        (link.dof, result.dof, 0.0, 0.0),
        (sign * link.estimate_without[kept], result.without[kept], 1e-4, 1e-6),
        (link.cook_distance[kept], result.cook[kept], 1e-3, 1e-8),
        (link.discrepancy, result.discrepancy, 1e-4, 1e-5),
        (link.discrepancy_expected, result.discrepancy_expected, 1e-4, 1e-5),
        (link.share, result.share, 2e-5, 1e-9),
        (sign * observed["residual"], result.residual, 1e-4, 1e-6),
        (observed["difference_error"], result.error, 1e-4, 1e-6),
    ):
        np.testing.assert_allclose(got, expected, rtol=rtol, atol=atol)
    return result


@pytest.mark.parametrize(("weights", "clip"), few(4, WAYS))
@pytest.mark.parametrize("seed", SEEDS)
def test_a_solution_is_that_of_full_matrices(tmp_path, seed, weights, clip):
    tables = drawn_tables(tmp_path, seed, n=40, far=(2, 5, 6) if clip == "median:1.5" else ())  # several in some cells
    link = linked(tables, weights=weights, clip=clip, errors=f"{KINDS},bootstrap" if clip == "none" else KINDS)
    average = compare(link, tables, weights).average
    if clip == "none":
        assert float(link.discrepancy_expected.sum()) == pytest.approx(float(link.chi2_expected))
        np.testing.assert_allclose(link.estimate, np.concatenate([EPSILON, OMEGA]) / MAS, atol=0.5)
    factor, residual = link.weight_factor.values, np.sqrt(link.discrepancy.values / average)
    expected = {"huber:1.5": np.minimum(1.0, 1.5 / residual), "median:1.5": residual <= 1.5 * np.median(residual)}
    np.testing.assert_allclose(factor, expected.get(clip, np.ones(40)), rtol=1e-9)
    assert (clip == "none", clip == "median:1.5") == (np.all(factor == 1.0), not factor[[2, 5, 6]].any())


@pytest.mark.parametrize(("seed", "weights"), [(3, "covariance"), *(slow(1, "equal"), slow(4, "covariance"))])
def test_what_a_clip_drops_has_no_part_in_the_rest(tmp_path, seed, weights):
    tables = drawn_tables(tmp_path, seed, far=(3, 7), scale=1.6)  # some are significant alone, and not among so many
    link = linked(tables, errors=KINDS, clip="discrepancy", weights=weights)
    dropped = np.flatnonzero(link.weight_factor.values == 0.0)
    assert {3, 7} <= set(dropped)
    assert int(link.n_sources) == 12 - len(dropped)
    compare(link, tables, weights)
    turned_round = linked(tables, errors=KINDS, clip="discrepancy", sign="satellite-reference", weights=weights)
    compare(turned_round, tables, weights, sign=-1.0)
    for name in ("estimate", "residual", "difference", "estimate_without", "step_estimate"):
        np.testing.assert_array_equal(turned_round[name], -link[name], err_msg=name)
    chosen = int(link.step_chosen)
    assert set(link.step_dropped.values[1 : chosen + 1]) == set(link.source.values[dropped])
    # without those dropped so far, up to the first step at which the worst is not significant among so many
    factor, significant = np.ones(12), []
    for step in range(int(link.step_chosen) + 2):
        if step:
            factor[list(link.source.values).index(str(link.step_dropped.values[step]))] = 0.0
        one = least_squares(tables, link.difference.values, weights, factor)
        np.testing.assert_allclose(link.step_estimate.values[step], one.x, rtol=1e-4, atol=1e-5)
        assert float(link.step_chi2[step]) == pytest.approx(one.chi2, rel=1e-4)
        assert float(link.step_dof[step]) == one.dof
        np.testing.assert_allclose(link.step_error.values[step], np.sqrt(np.diag(one.scaled)), rtol=1e-3)
        ratio = np.where(factor > 0.0, one.discrepancy / one.average, -1.0)
        worst = int(np.argmax(ratio))
        if step + 1 < link.sizes["step"]:
            assert str(link.step_dropped.values[step + 1]) == str(link.source.values[worst])
        chance = stats.chi2.sf(one.count[worst] * ratio[worst], one.count[worst])
        significant.append(chance * factor.sum() <= 0.01)
    assert int(link.step_chosen) == significant.index(False)
    many = gaia(tmp_path / "many.fits", stars(310))
    most = linksweep.tie(many, "zero-motion", "spin", clip="discrepancy:305", accept_misfit=True)
    assert (int(most.step_chosen), int(most.n_sources)) == (305, 5)  # more than the steps that are always computed
    assert "\n* 305 " in Result(most).tables()[-1].text()


@pytest.mark.parametrize("clip", ["rayleigh", *map(slow, ("none", "median:2", "huber:1.5", "discrepancy"))])
def test_sources_that_say_nothing_change_nothing(tmp_path, clip):
    """Without a motion and with one row at another epoch a source has no observation left: no error counts it."""
    tables = drawn_tables(tmp_path, 1)
    ours, rows = tables.ours, tables.rows
    more = only(ours.taken(np.arange(36) % 12), POSITION)
    later = replace(more, epoch=more.epoch + 5.0)
    together = {}
    for name, first, second in (("own", ours, more), ("rows", rows, later)):
        both = replace(joined(first, second), radial_velocity=np.zeros(len(first) + 36), apparent=None)
        numbers = np.arange(12) if name == "own" else tables.source
        together[name] = gaia(tmp_path / f"{name}.ecsv", both, source_id=np.append(numbers, np.arange(12, 48)) + 10**17)
    link = linked(SimpleNamespace(satellite=together["own"], reference=together["rows"]), errors=KINDS, clip=clip)
    plain = linked(tables, errors=KINDS, clip=clip)
    assert link.n_observations.values[12:].tolist() == [0.0] * 36
    for name in ("estimate", "errors", "chi2", "chi2_expected", "dof", "n_sources"):
        np.testing.assert_allclose(link[name], plain[name], rtol=1e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("clip", ["none", "huber:1.2", "median:3", "discrepancy:2"])
def test_sources_that_do_not_fit_into_memory_give_the_same_link(tmp_path, monkeypatch, clip):
    tables = drawn_tables(tmp_path, 8, n=14, far=(3, 7))
    options = {"clip": clip, "errors": "formal,scaled,cells"}
    plain = linked(tables, **options)
    monkeypatch.setattr("linksweep.core.tie.problem.KEPT_NUMBERS", 0)
    monkeypatch.setattr("linksweep.core.tie.problem.BLOCK", 4)
    monkeypatch.setattr("linksweep.core.tie.problem.GATHERED", 11)
    link = linked(tables, **options)
    assert "cook_distance" not in link
    for name in ("estimate", "errors", "covariances", "chi2", "chi2_expected", "dof", "discrepancy", "weight_factor"):
        np.testing.assert_allclose(link[name], plain[name], rtol=1e-6, atol=1e-9, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_separations_and_the_clip_of_rayleigh(tmp_path, seed):
    """X and the separation of each row, as `weight` and `residuals` show them: of a position, else of a motion."""
    tables = drawn_tables(tmp_path, seed, n=20, far=(4,), coarse=(6, 8, 11))
    link, ours, rows = linked(tables, clip="rayleigh", known_spin=list(OMEGA / MAS)), tables.ours, tables.rows
    cov, own_cov, (x, apart) = rows.covariance() / MAS**2, ours.covariance() / MAS**2, np.zeros((2, 20))
    for k, s in enumerate(tables.source):
        partials, years = np.eye(5), rows.epoch[k] - ours.epoch[s]
        partials[0, 3] = partials[1, 4] = years
        positions = np.isfinite(rows.errors[0, k])
        pair = [0, 1] if positions else [3, 4]
        if np.isnan(ours.errors[3, s]) and (years != 0.0 or not positions):
            continue  # it depends on a motion that nobody knows
        d = link.difference.values[k, pair]
        whole = (cov[k] + partials @ own_cov[s] @ partials.T)[np.ix_(pair, pair)]
        x[s] = max(x[s], np.sqrt(d @ np.linalg.solve(whole, d)))
        if positions:
            apart[s] = max(apart[s], np.hypot(*d))
    np.testing.assert_allclose(link.normalised_separation, x, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(link.separation, apart, rtol=1e-4, atol=1e-6)
    limit = np.sqrt(2.0 * np.log(20))
    assert np.any((x <= limit) & (apart >= 10.0))
    np.testing.assert_array_equal(link.weight_factor.values > 0.0, (x <= limit) & (apart < 10.0))


@pytest.mark.parametrize("some", [("motion", "all"), *map(slow, (("five-parameter", "position"), ("all",)))])
def test_jitter_is_what_one_would_add_by_hand(tmp_path, some):
    tables, rng = drawn_tables(tmp_path, 1), np.random.default_rng(1)
    jitter = {kind: (0.0 if kind == "motion" else rng.uniform(0.0, 1.0), rng.uniform(0.0, 1.0)) for kind in some}
    # one number is that of motions for rows that have nothing else
    said = ",".join(f"{kind}={a}:{b}" if kind != "motion" else f"{kind}={b}" for kind, (a, b) in jitter.items())
    rows, present = tables.rows, np.isfinite(tables.rows.errors)
    kinds = np.where(present[2], "five-parameter", np.where(present[0], "position", "motion"))
    covariance = rows.covariance()
    for k, kind in enumerate(kinds):
        position, motion = jitter.get(kind, jitter.get("all", (0.0, 0.0)))
        covariance[k][range(5), range(5)] += np.array([position] * 3 + [motion] * 2) ** 2 * MAS**2 * present[:, k]
    sigma, correlations = by_errors(covariance)
    correlations = np.array([correlations[pair] for pair in PAIRS])
    by_hand = replace(rows, errors=np.where(present, sigma, np.nan), correlations=correlations)
    expected = gaia(tmp_path / "by_hand.ecsv", by_hand, source_id=tables.source + 10**17)
    result = linked(tables, jitter=said)
    other = linked(SimpleNamespace(satellite=tables.satellite, reference=expected))
    for name in ("estimate", "errors", "chi2", "discrepancy", "difference_error"):
        np.testing.assert_allclose(result[name], other[name], rtol=1e-7, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("errors", ["formal", "scaled", "jackknife"])
def test_powers_are_the_integrals_of_their_fields_over_the_sky(tmp_path, errors):
    ours = stars(150, 3, pm=0.1)
    path = gaia(tmp_path / "quasars.ecsv", ours)
    link = linksweep.tie(path, "zero-motion", "spin", degree=3, errors=errors, accept_misfit=True)
    twice = linksweep.tie(gaia(path, ours.taken(np.r_[:150, 3])), "zero-motion", "spin", accept_misfit=True)
    assert "row 151 of quasars.ecsv: the position of another row; both count" in twice.attrs["notes"]
    heights, of_heights = np.polynomial.legendre.leggauss(12)
    ra, dec = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False), np.arcsin(heights))
    weights = np.repeat(of_heights, 24) * 2.0 * np.pi / 24
    sky = Objects(ra.ravel(), dec.ravel(), np.zeros(ra.size), np.zeros(ra.size), {})
    unknowns = parse_unknowns("spin,glide,vsh_motion:2-3")
    assert list(unknowns.labels) == list(link.unknown.values)
    assert len(parse_unknowns("spin,vsh_motion:1-3")) == len(unknowns)  # without the glide it is a harmonic
    fields = unknowns.derivatives(sky, np.zeros(ra.size))[1][:, -2:]
    gram = np.einsum("kin,lin,n->kl", fields, fields, weights)
    names = np.array([str(label) for label in unknowns.labels])
    for which, kind, first in (("toroidal", "t", "omega"), ("spheroidal", "s", "glide")):
        for degree in (1, 2, 3):
            start = first if degree == 1 else f"vsh_motion_{kind}_{degree}_"
            at = np.flatnonzero(np.char.startswith(names, start))
            assert len(at) == 2 * degree + 1, names
            x, v, g = link.estimate.values[at], link.covariance.values[np.ix_(at, at)], gram[np.ix_(at, at)]
            one = link.sel(field=f"motion {which}", degree=degree)
            chi2 = x @ np.linalg.solve(v, x)
            expected = {"power": x @ g @ x, "power_noise": np.trace(g @ v), "power_chi2": chi2}
            p, left = 2 * degree + 1, 150 - 2 * degree - 1
            by_kind = {"formal": stats.chi2.sf(chi2, p), "scaled": stats.f.sf(chi2 / p, p, float(link.dof))}
            hotelling = stats.f.sf(chi2 * left / (p * 149), p, left)
            expected["power_probability"] = by_kind.get(errors, hotelling)
            assert {name: float(one[name]) for name in expected} == pytest.approx(expected)
            assert expected["power_probability"] > 1e-9
