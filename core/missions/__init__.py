"""The built-in missions: values by name.  A new one is a module that makes a `Mission`, and a line here."""

from collections.abc import Mapping
from types import MappingProxyType

from linksweep.core.missions.gaia import GAIA_2001, GAIA_DR3, GAIA_DR4, GAIA_DR5, PyGaia
from linksweep.core.missions.mission import (
    Curve,
    Exponentials,
    Floor,
    LogLinear,
    Mission,
    MissionUnavailableError,
    accuracy_curves,
)
from linksweep.core.missions.paper import AMEX, AMEX_PM, GAIA, GAIA_PM

__all__ = [
    "AMEX_PM",
    "GAIA_PM",
    "MISSIONS",
    "Curve",
    "Exponentials",
    "Floor",
    "LogLinear",
    "Mission",
    "MissionUnavailableError",
    "PyGaia",
    "accuracy_curves",
]

MISSIONS: Mapping[str, Mission] = MappingProxyType(
    {
        "amex": AMEX,
        "gaia": GAIA,
        "gaia-2001": GAIA_2001,
        "gaia-dr3": GAIA_DR3,
        "gaia-dr4": GAIA_DR4,
        "gaia-dr5": GAIA_DR5,
    }
)
"""The built-in missions by name."""
