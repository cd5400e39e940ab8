"""The command line; each command calls one function of the library, imported when it is needed."""

from linksweep.sweep.cli import run, submit, look, watch, tables  # noqa: F401, I001 (they add their commands, as the help lists them)
from linksweep.sweep.cli.group import main

__all__ = ["main"]
