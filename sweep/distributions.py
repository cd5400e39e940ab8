"""Versions of installed distributions."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache  # a process computes with what it has imported, whatever is installed meanwhile; and each task asks
def version_of(distribution: str) -> str:
    """Return the version of a distribution when this was first called; "not installed" if there was none."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"
