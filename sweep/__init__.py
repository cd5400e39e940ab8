"""The platform: studies, their grids, execution, stores, and the analysis of results.

``import linksweep`` is the public interface; names that scripts of version 0.1 import from here are still available.
"""

from typing import TYPE_CHECKING, Any

import linksweep

if TYPE_CHECKING:
    from linksweep import find, fit_levelling, fit_power_law, open, plot, ratio, run  # noqa: A004

__all__ = ["find", "fit_levelling", "fit_power_law", "open", "plot", "ratio", "run"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'sweep' has no attribute {name!r}")
    return getattr(linksweep, name)


def __dir__() -> list[str]:
    return __all__
