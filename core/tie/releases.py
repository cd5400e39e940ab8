"""How the errors of a Gaia release follow from those of another."""

from dataclasses import dataclass, replace

import numpy as np

from core.tie.astrometry import Astrometry


@dataclass(frozen=True)
class Release:
    """Reference epoch (Julian year) and the months of observations of a release."""

    epoch: float
    months: float


RELEASES = {
    "dr2": Release(2015.5, 22.0),
    "dr3": Release(2016.0, 34.0),
    "dr4": Release(2017.5, 66.0),
    "dr5": Release(2020.0, 126.0),
}
"""Sources: Gaia Collaboration 2018 (DR2, 2014.56 to 2016.39), 2021 (EDR3 to 2017.41); ESA's pages of the data releases
for DR4 (66 months, J2017.5) and DR5 (to the end of observations in January 2025; its epoch is not announced, here the
middle).
"""


def factors(old: str, new: str) -> tuple[float, float]:
    """Return by what errors of positions and parallaxes, and of motions, are multiplied from one release to another.

    Positions go as T^-1/2 and motions as T^-3/2 with the time T that observations span, as on ESA's Gaia science
    performance pages.  Raises ValueError for an unknown release.
    """
    for name in (old, new):
        if name not in RELEASES:
            raise ValueError(f"no release {name!r}; there are {', '.join(RELEASES)}")
    ratio = RELEASES[old].months / RELEASES[new].months
    return ratio**0.5, ratio**1.5


def released(satellite: Astrometry, old: str, new: str) -> Astrometry:
    """Return the satellite's table as a later release may give it: errors scaled, correlations kept, at its epoch.

    For forecasts: the values are the same, so only errors mean something.
    """
    position, motion = factors(old, new)
    scale = np.array([position, position, position, motion, motion])[:, None]
    shift = RELEASES[new].epoch - RELEASES[old].epoch
    return replace(satellite, errors=satellite.errors * scale, epoch=satellite.epoch + shift)
