"""The two missions of Metz & Geffert 2004, with curves that were fitted to the paper's tables."""

import numpy as np

from linksweep.core.missions.mission import Exponentials, Floor, Mission

AMEX_PM = Exponentials(((0.139, 0.215, 9.0), (14.2, 0.973, 15.0)))
GAIA_PM = Exponentials(((0.01496, 0.443, 15.0),))

AMEX = Mission(
    curve_pos_mas=AMEX_PM.times(0.60),
    curve_pm_mas_yr=AMEX_PM,
    nominal_length_yr=2.0,
    faint_limit_mag=np.inf,
    source="two exponentials fitted to the 28 AMEX numbers of Metz & Geffert 2004 (Tables 1 and 2) with "
    "inverse-variance weights; position/motion ratio of DIVA, 0.15 mas to 0.25 mas/yr (at V = 9, where the "
    "fitted curve has 0.18 mas/yr)",
    # from Algol, of Table 2, to the quasars of Table 1; those beyond V = 17 have next to no weight
    valid_mag=(2.1, 20.0),
    floor=Floor(0.60 * 0.0315, 0.0315, source="the curve at V = 2.1, its brightest object"),
)

GAIA = Mission(
    curve_pos_mas=GAIA_PM.times(1.15),
    curve_pm_mas_yr=GAIA_PM,
    nominal_length_yr=5.0,
    faint_limit_mag=np.inf,
    source="one exponential fitted to the GAIA column of Metz & Geffert 2004, Table 1",
    valid_mag=(12.8, 20.0),
    floor=Floor(0.003, 0.003, source="ESA's prediction of 2001, constant from G = 12 on (Perryman et al. 2001)"),
)
