"""The command line; each command calls one function of the library, imported when it is needed."""

from linksweep.sweep.cli import (  # noqa: F401 (they add their commands to the group)
    analysis,
    match,
    paper,
    plot,
    running,
    store,
    studies,
    tie,
)
from linksweep.sweep.cli.group import main

__all__ = ["main"]
