"""The reference catalogues of a study, values by name.  A new one is a module with a `CatalogueKind`, and a line
here.
"""

from collections.abc import Mapping
from types import MappingProxyType

from linksweep.core.catalogues.file import File
from linksweep.core.catalogues.galaxies import Galaxies
from linksweep.core.catalogues.kind import CatalogueKind
from linksweep.core.catalogues.quasars import Quasars
from linksweep.core.catalogues.radio_stars import RadioStars
from linksweep.core.catalogues.synthetic import Synthetic

__all__ = ["CATALOGUES", "CatalogueKind"]

CATALOGUES: Mapping[str, CatalogueKind] = MappingProxyType(
    {
        "synthetic": Synthetic(),
        "quasars": Quasars(),
        "galaxies": Galaxies(),
        "radio-stars": RadioStars(),
        "file": File(),
    }
)
"""The catalogues by the name that a study gives them."""
