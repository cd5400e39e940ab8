"""A distributed parameter-sweep platform for experiments that add up realisations.

``sweep.run`` runs a study, ``sweep.open`` reads its results; both give an `xarray.Dataset`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sweep.api import open, run  # noqa: A004

__all__ = ["open", "run"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sweep import api  # only here: it imports all that a run needs, and most commands need less

    return getattr(api, name)
