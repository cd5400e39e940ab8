"""Gaia as ESA predicted it in 2001, and its data releases by the formulas of PyGaia."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.missions.mission import Floor, LogLinear, Mission, MissionUnavailableError

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

Release = Literal["dr3", "dr4", "dr5"]

DR3_YEARS = 34 / 12

BRIGHT_MAG, BRIGHT_POS_MAS, BRIGHT_PM_MAS_YR = 8.0, 0.037, 0.048
"""Medians of DR3's proper-motion errors at G < 8 are 0.046 to 0.051 mas/yr, where PyGaia's formula says 0.012;
positions follow from PyGaia's ratio of positions to motions.
"""


@dataclass(frozen=True)
class PyGaia:
    """The predicted error of a Gaia release per coordinate, mean square of ra* and dec, in mas or mas/yr.

    The study's V is taken as G; for quasars G - V is about -0.1 to 0 mag, which changes an error by at most 9 %.  The
    formula holds for G = 3 to 21 and is constant brighter than 13.
    Raises MissionUnavailableError, when it is called, without the package PyGaia.
    Source: PyGaia (A. Brown), `pygaia.errors.astrometric`, the model of ESA's Gaia science performance pages.
    """

    quantity: Literal["position", "proper_motion"]
    release: Release

    def __call__(self, v_mag: Array) -> Array:
        """Return the error at each magnitude."""
        try:  # only here: PyGaia is optional, and importing it takes half a second
            from pygaia.errors import astrometric
        except ImportError as error:
            raise MissionUnavailableError(
                f"the model 'gaia-{self.release}' needs PyGaia: pip install 'linksweep[gaia]' ({error})"
            ) from error
        formula = getattr(astrometric, f"{self.quantity}_uncertainty")
        ra_uas, dec_uas = formula(np.atleast_1d(v_mag), release=self.release)
        sigma_mas: Array = np.sqrt((ra_uas**2 + dec_uas**2) / 2.0) / 1000.0
        return sigma_mas.reshape(np.shape(v_mag))


def _release(release: Release, months: float) -> Mission:
    years = months / 12.0
    return Mission(
        curve_pos_mas=PyGaia("position", release),
        curve_pm_mas_yr=PyGaia("proper_motion", release),
        nominal_length_yr=years,
        faint_limit_mag=21.0,
        source=f"PyGaia, pygaia.errors.astrometric, release {release}; V taken as G; {months:g} months of data",
        valid_mag=(BRIGHT_MAG, 21.0),
        floor=Floor(
            BRIGHT_POS_MAS * (years / DR3_YEARS) ** -0.5,
            BRIGHT_PM_MAS_YR * (years / DR3_YEARS) ** -1.5,
            BRIGHT_MAG,
            source="medians of DR3 at G < 8, for other releases as T^-1/2 and T^-3/2",
        ),
    )


# The length is the one PyGaia's numbers stand for: it puts DR4 at 60 months, though DR4 itself will have 66.
GAIA_DR3, GAIA_DR4, GAIA_DR5 = _release("dr3", 34), _release("dr4", 60), _release("dr5", 120)
