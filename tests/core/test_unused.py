"""What a study of the link sets in vain is refused by name; what makes sense works instead."""

import numpy as np
import pytest
from astropy.table import Table

from linksweep.core.catalogues import CATALOGUES
from linksweep.core.errors import ERROR_KINDS
from linksweep.core.experiment import evaluate, link
from linksweep.core.parameters import PARAMETERS
from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.reader import study_from_dict


@pytest.fixture
def table(tmp_path):
    rng = np.random.default_rng(1)
    columns = {"ra": rng.uniform(0.0, 360.0, 20), "dec": np.degrees(np.arcsin(rng.uniform(-1, 1, 20)))}
    columns |= {"v_mag": np.linspace(9.0, 19.0, 20), "ref_epoch": np.full(20, 2016.0)}
    Table(columns).write(tmp_path / "sky.ecsv")
    return str(tmp_path / "sky.ecsv")


def study(axes=None, exclude=(), **fixed):
    return study_from_dict({"title": "", "axes": axes or {}, "fixed": fixed, "exclude": list(exclude)})


def problems(axes=None, exclude=(), **fixed):
    with pytest.raises(SweepError) as error:
        make_grid(study(axes, exclude, **fixed))
    return error.value.problems


@pytest.mark.parametrize(
    ("fixed", "sentence"),
    [
        ({"catalogue": "quasars", "mean_pm": 5.0}, "mean_pm = 5.0 changes nothing: it is for catalogue = 'synthetic'"),
        (
            {"n_obj": 9, "reference_sigma_pm": 2.0},
            "reference_sigma_pm = 2.0 changes nothing: it is for reference_errors",
        ),
        ({"n_obj": 9, "satellite_errors": "normal", "model": "gaia"}, "model = 'gaia' changes nothing: it is for sate"),
        (
            {"catalogue": "quasars", "positions": "own"},
            "positions = 'own' changes nothing: it is for catalogue = 'radi",
        ),
        (
            {"n_obj": 9, "pm_distribution": "constant"},
            "pm_distribution = 'constant' changes nothing: it is for objects",
        ),
        ({"n_obj": 9, "pmra_cos_dec": True}, "pmra_cos_dec = True changes nothing: it is for catalogue = 'file'"),
        (
            {"n_obj": 9, "glide": [0.0, 0.0, 4.0]},
            "glide = (0.0, 0.0, 4.0) changes nothing: it is for aberration = true",
        ),
        (
            {"n_obj": 9, "satellite_errors": "none", "weighting": "equal"},
            "weighting = 'equal' changes nothing: without",
        ),
        (
            {"n_obj": 9, "directions": "random", "epsilon_size": 1.0, "epsilon": [0.0, 0.0, 1.0]},
            "epsilon = (0.0, 0.0, 1.0) changes nothing: its direction is random",
        ),
    ],
)
def test_what_changes_nothing_is_refused_by_name(fixed, sentence):
    (found,) = problems(**fixed)
    assert found.startswith(sentence)


def test_an_axis_is_refused_where_it_changes_nothing_unless_those_points_are_excluded():
    axes = {"catalogue": ["synthetic", "quasars"], "mean_pm": [0.0, 50.0]}
    (found,) = problems(axes, n_obj=20)
    assert found.startswith("the axis mean_pm changes nothing at some points")
    assert len(make_grid(study(axes, [{"catalogue": "quasars", "mean_pm": 50.0}], n_obj=20))) == 4


def test_every_parameter_applies_somewhere():
    """What a kind says that it uses is declared, and each is known to the lists that are gone through."""
    declared = {p.name for p in PARAMETERS}
    of_catalogues = frozenset().union(*(kind.parameters for kind in CATALOGUES.values()))
    of_errors = frozenset().union(*(k.uses(s) for k in ERROR_KINDS.values() for s in k.sides))
    assert of_catalogues | of_errors <= declared


def sums(point):
    generators = np.random.default_rng(1), np.random.default_rng(2)
    return evaluate([point], 4, *generators)


@pytest.mark.parametrize("catalogue", ["synthetic", "quasars", "galaxies", "radio-stars"])
def test_what_is_unused_really_changes_nothing_and_the_rest_of_a_catalogue_something(catalogue):
    """Another value of each parameter, one at a time: the same bits if and only if it is said to be unused."""
    others = {
        **{"v_min": 13.0, "v_max": 13.4, "counts": "completed", "mean_pm": 50.0, "pm_distribution": "constant"},
        **{"positions": "own", "zone_of_avoidance": 20.0, "sky_contrast": 0.4, "model": "gaia", "mission_length": 3.0},
        **{"error_scale": 2.0, "satellite_error_scale": 2.0, "reference_error_scale": 2.0, "glide": (0.0, 0.0, 9.0)},
        **{
            "satellite_sigma_pos": 2.0,
            "reference_sigma_pos": 2.0,
            "satellite_sigma_pm": 2.0,
            "reference_sigma_pm": 2.0,
        },
        "weighting": "equal",
        **{"satellite_floor_pm": 0.5, "reference_floor_pm": 0.5, "satellite_error_ratio": 2.0},
        **{"reference_error_ratio": 2.0, "zonal_pm": 1.0, "zonal_length": 60.0, "omega_slope": (0.0, 0.0, 1.0)},
        **{"omega_slope_size": 1.0, "magnitude_equation_pmra": 1.0, "magnitude_equation_pmdec": 1.0, "v_zero": 9.0},
        **{"motion_field": "t_2_0", "motion_field_size": 2.0},
    }
    base = link.defaults() | {"catalogue": catalogue, "n_obj": 8}
    unused, reference = link.unused(base), sums(base)
    for name, value in others.items():
        if link.check(base | {name: value}) is not None:
            assert catalogue == "radio-stars", name  # which has no limits, and says so
            continue
        found = sums(base | {name: value})
        same = all(np.array_equal(found[k], reference[k], equal_nan=True) for k in reference)
        assert same == (name in unused), name


@pytest.mark.parametrize(("v_min", "left"), [(14.0, 88 - 28), (14.5, 88 - 49), (None, 88), (5.0, 88)])
def test_a_bright_limit_of_quasars_leaves_out_those_that_the_counts_say(v_min, left):
    kind, point = CATALOGUES["quasars"], link.defaults() | {"catalogue": "quasars", "v_max": 15.0, "v_min": v_min}
    drawn = kind.draw(point, np.random.default_rng(3))
    assert len(drawn) == kind.size(point) == left
    assert drawn.v_mag.min() >= (v_min or 12.8)
    assert drawn.v_mag.max() <= 15.0


def test_a_bright_limit_inside_a_bin_keeps_the_law_of_the_counts():
    """Magnitudes above 14.2 in the bin to 14.5 follow N = 28 (49/28)^((V - 14)/0.5): compared with its inverse."""
    point = link.defaults() | {"catalogue": "quasars", "v_max": 14.5, "v_min": 14.2}
    rng, ratio = np.random.default_rng(4), 49 / 28
    v_mag = np.concatenate([CATALOGUES["quasars"].draw(point, rng).v_mag for _ in range(400)])
    low = ratio ** ((14.2 - 14.0) / 0.5)
    uniform = (ratio ** ((v_mag - 14.0) / 0.5) - low) / (ratio - low)
    from scipy.stats import kstest

    assert kstest(uniform, "uniform").pvalue > 1e-3


def test_a_bright_limit_of_galaxies_and_files(table):
    galaxies = link.defaults() | {"catalogue": "galaxies", "v_min": 12.5}
    drawn = CATALOGUES["galaxies"].draw(galaxies, np.random.default_rng(5))
    assert len(drawn) == 116
    assert drawn.v_mag.min() >= 12.5
    one = make_grid(study({"v_min": [9.0, 15.0]}, catalogue="file", file=table))
    sizes = [len(CATALOGUES["file"].objects(p.parameters)) for p in one.points()]
    assert sizes == [20, np.sum(np.linspace(9.0, 19.0, 20) >= 15.0)]
