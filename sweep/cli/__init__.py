"""The command line; each command calls one function of the library, imported when it is needed."""

from linksweep.sweep.cli.group import main

__all__ = ["main"]
