"""The command line; each command calls one function of the library, imported when it is needed."""

from sweep.cli import about, again, analysis, drawing, match, paper, reading, report, running, scaling
from sweep.cli.group import main

__all__ = [
    "about",
    "again",
    "analysis",
    "drawing",
    "main",
    "match",
    "paper",
    "reading",
    "report",
    "running",
    "scaling",
]
