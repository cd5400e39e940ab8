"""The command line; each command calls one function of the library, imported when it is needed."""

from sweep.cli import (
    analysis,
    demo,
    match,
    merge,
    paper,
    plot,
    report,
    rerun,
    running,
    scaling,
    sensitivity,
    store,
    studies,
    tie,
)
from sweep.cli.group import main

__all__ = [
    "analysis",
    "demo",
    "main",
    "match",
    "merge",
    "paper",
    "plot",
    "report",
    "rerun",
    "running",
    "scaling",
    "sensitivity",
    "store",
    "studies",
    "tie",
]
