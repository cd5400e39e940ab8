"""Finds stores by the name of their study: ``quasars`` is ``results/quasars.zarr`` of the working directory."""

from contextlib import suppress
from pathlib import Path

from linksweep.sweep.stores.location import Location, Where, located

RESULTS = Path("results")
"""The folder where a run puts its store by default."""


def default_store(name: str) -> Path:
    """Return where the store of a study is by default."""
    return RESULTS / f"{name}.zarr"


def store_named(where: Where) -> Location:
    """Return the place that an address, a path or the name of a study names; an existing path takes precedence."""
    if isinstance(where, str) and Path(where).name == where:
        default = default_store(where.removesuffix(".toml"))
        with suppress(OSError, ValueError):  # names that no file can have
            if not Path(where).exists() and default.exists():
                return located(default)
    return located(where)


def short_name(store: Location) -> str:
    """Return the shortest text that `store_named` takes for a store."""
    text = str(store)
    name = Path(text).name.removesuffix(".zarr")
    return name if Path(text) == default_store(name) and not Path(name).exists() else text
