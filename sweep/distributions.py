"""Versions of installed distributions."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache  # a process computes with what it has imported, whatever is installed meanwhile; and each task asks
def version_of(distribution: str) -> str:
    """Return the version that a distribution had when it was asked for first; "not installed" without one."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"
