"""Gaia as ESA predicted it in 2001."""

from core.missions.curves import LogLinear
from core.missions.mission import Mission

_MAG = tuple(float(g) for g in range(10, 22))
_PM_UAS = (3, 3, 3, 4, 5, 8, 13, 20, 34, 60, 120, 380)
_POS_UAS = (3, 3, 3, 4, 6, 9, 15, 23, 39, 70, 140, 440)

GAIA_2001 = Mission(
    curve_pos_mas=LogLinear(_MAG, tuple(s / 1000.0 for s in _POS_UAS)),
    curve_pm_mas_yr=LogLinear(_MAG, tuple(s / 1000.0 for s in _PM_UAS)),
    nominal_length_yr=5.0,
    faint_limit_mag=21.0,
    source="ESA's 2001 prediction for G = 10..21 (Perryman et al. 2001), log-linear between; "
    "the table was not confirmed in print",
    valid_mag=(10.0, 21.0),
)
