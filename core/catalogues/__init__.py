"""The reference catalogues of a study, values by name.  A new one is a module with a `CatalogueKind`, and a line
here.
"""

from collections.abc import Mapping
from types import MappingProxyType

from core.catalogues.file import File
from core.catalogues.galaxies import Galaxies
from core.catalogues.kind import CatalogueKind
from core.catalogues.quasars import Quasars
from core.catalogues.radio_stars import RadioStars
from core.catalogues.synthetic import Synthetic

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
