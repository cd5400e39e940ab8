"""The error models of a study, values by name.  A new one is a module with an `ErrorKind`, and a line here."""

from collections.abc import Mapping
from types import MappingProxyType

from linksweep.core.catalogue import SIDES
from linksweep.core.errors.magnitude import Magnitude, MagnitudeErrors
from linksweep.core.errors.model import ErrorKind, ErrorModel, Errors
from linksweep.core.errors.normal import ErrorFree, NoErrors, Normal, NormalErrors
from linksweep.core.errors.own import CatalogueErrors, Own

__all__ = [
    "ERROR_KINDS",
    "SIDES",
    "CatalogueErrors",
    "ErrorKind",
    "ErrorModel",
    "Errors",
    "MagnitudeErrors",
    "NoErrors",
    "NormalErrors",
    "error_kinds",
]

ERROR_KINDS: Mapping[str, ErrorKind] = MappingProxyType(
    {
        "none": ErrorFree(),
        "normal": Normal(),
        "magnitude": Magnitude(),
        "catalogue": Own(),
    }
)
"""The error models by the name that a study gives them."""


def error_kinds(side: str) -> tuple[str, ...]:
    """Return the names of the error models that a side may have."""
    return tuple(name for name, kind in ERROR_KINDS.items() if side in kind.sides)
