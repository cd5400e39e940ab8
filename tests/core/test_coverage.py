"""The errors of the link's results cover: over independent copies (value - truth) / error scatters by one."""

import numpy as np
import pytest

import linksweep
from tests.sweep.test_coverage import assert_covers
from tests.tiers import slow

QUASARS = {"catalogue": "quasars", "v_max": 14.0, "model": "gaia", "method": "projected"}
EQUAL = {"satellite_errors": "normal", "n_obj": 30}
LEAK = {**EQUAL, "satellite_sigma_pm": 0.02, "motion_field": "t_2_0", "motion_field_size": 0.5}
GLIDE = {"aberration": True, "glide": [300.0, 500.0, 0.0], "sky_contrast": 0.8}
NOISY = {**EQUAL, "reference_errors": "normal", "mean_pm": 300.0}
LINKS = {
    **{"quasars": QUASARS, "noisy": NOISY, "leak": LEAK, "glide": {**EQUAL, **GLIDE}},
    **{"aberration": {**QUASARS, "aberration": True}, "slope": {**NOISY, "omega_slope": [0.0, 0.0, 0.2]}},
    **{"three-objects": {**EQUAL, "n_obj": 3}, "underestimated": {**EQUAL, "satellite_error_ratio": 2.0}},
    "poor-geometry": {**EQUAL, "zone_of_avoidance": 80.0, "method": "projected"},
    "radio-stars": {"catalogue": "radio-stars", "reference_errors": "catalogue", "n_obj": 10},
    "equal-weights": {"n_obj": 40, "weighting": "equal", "v_min": 8.0, "v_max": 16.0},
    "zonal": {**EQUAL, "zonal_pm": 0.5, "zonal_pos": 0.5, "zonal_length": 60.0},
    "leak-into-a-glide": {**LEAK, "solve_glide": True, "satellite_sigma_pm": 1.0},
}
ONE = [("quasars", 1, 64), ("quasars", 1, 2048), ("poor-geometry", 1, 512), ("slope", 1, 128), ("leak", 1, 128)]
FEW = [("quasars", n_cat, 64) for n_cat in (2, 5, 12)] + [("aberration", 5, 64), ("aberration", 12, 1024)]
MORE = [("three-objects", 100, 64), ("glide", 8, 64), ("leak", 24, 1), ("quasars", 5, 1)]
OTHERS = [(case, 12, 64) for case in LINKS if case not in ("quasars", "three-objects", "poor-geometry", "glide")]


@pytest.mark.parametrize(("case", "n_cat", "n_sim"), [("leak", 20, 8), *(slow(*a) for a in ONE + FEW + MORE + OTHERS)])
def test_every_error_of_a_link(tmp_path, case, n_cat, n_sim):
    """That of realisations holds the catalogues fixed, that of their choice their prediction, and both make up all."""
    axes = {"error_scale": [1.0 + 1e-9 * k for k in range(150)]}
    sampling = {"n_sim": n_sim, "n_cat": n_cat, "seed": 3}
    study = {"title": "Copies", "axes": axes, "fixed": LINKS[case], "sampling": sampling}
    dataset = linksweep.run(study, tmp_path / "s.zarr", pool="serial")
    glide = ("glide_sigma",) if "solve_glide" in LINKS[case] else ()
    for name in ("sigma", "sigma_spin", "sigma_orientation", *glide):
        value, by_chance, predicted = (dataset[f"{name}{end}"] for end in ("", "_mc_error", "_rms_predicted"))
        assert_covers((value - predicted) / by_chance)
        if n_cat >= 5:
            truth, of_catalogues = np.sqrt(np.mean(predicted**2, axis=0)), dataset[f"{name}_catalogue_error"]
            assert_covers((predicted - truth) / of_catalogues, dof=n_cat - 1)
            assert_covers((value - truth) / np.hypot(by_chance, of_catalogues), dof=n_cat - 1)
    if n_cat >= 5:
        for name in ("chi2", "condition_number")[: 1 + (case != "three-objects")]:  # whose conditions have no mean
            assert_covers((dataset[name] - dataset[name].mean()) / dataset[f"{name}_mc_error"], dof=n_cat - 1)
    elif n_cat == 1 and case in ("quasars", "poor-geometry"):
        assert_covers((dataset["chi2"] - dataset["dof"]) / dataset["chi2_mc_error"])
    for name in ("bias", "glide_bias")[: 1 + len(glide)]:
        predicted = dataset[f"{name}_predicted"]
        if n_cat == 1:
            assert_covers((dataset[name] - predicted) / dataset[f"{name}_mc_error"])
        if n_cat >= 5:
            assert_covers((dataset[name] - predicted.mean("error_scale")) / dataset[f"{name}_mc_error"], dof=n_cat - 1)
