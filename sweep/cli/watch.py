"""The command that watches runs, and what it shows in a terminal."""

import signal
import sys
import time
from collections.abc import Iterable
from contextlib import nullcontext
from typing import TYPE_CHECKING

import click

from linksweep.sweep.cli import group, options
from linksweep.sweep.cli.options import flag, opt
from linksweep.sweep.formatting import counted, harmless

if TYPE_CHECKING:
    from rich.text import Text

    from linksweep.sweep.running.status import Tile, Watched
    from linksweep.sweep.stores.location import Location

MOST_ROWS = 12
"""Rows of tiles in a terminal."""

COLOURS = {"running": "cyan", "done": "green", "finished": "green", "failed": "bold red", "stopped": "yellow"}
MARKS = {"done": "█", "failed": "×", "waiting": "·"}
PARTLY = "▁▂▃▄▅▆▇"
"""Marks of a tile that is running, by how much of it is done."""


@group.command("Look", "Watch runs: points, speed, failures; --web: a page")
def watch(
    stores: "tuple[Location, ...]" = options.STORES,
    web: bool = flag("Show figures too, on a page that only this machine can open."),
    interval: float = opt("Seconds between looks.", type=click.FloatRange(0.2, 3600.0), default=2.0),
) -> None:
    """Watch the runs in STORE, which may begin later: a tile for each point, speed and time left, reasons of failures.

    Any machine that can read the stores can watch; nothing is written. It ends when all runs have ended; with --web, or
    while a store is not there yet, at Ctrl-C. Where standard output is no terminal, it is shown once.

    \b
    sweep watch quasars
    sweep watch results/quasars.zarr s3://bucket/grid.zarr --web
    """
    from linksweep.sweep.interrupt import RunInterruptedError, watched

    if not stores:
        raise click.UsageError("name a store")
    try:
        with watched():
            _on_a_page(stores, interval) if web else _in_the_terminal(stores, interval)
    except RunInterruptedError as stop:
        # Ctrl-C is how one stops watching; any other signal came from elsewhere.
        if stop.signal != signal.SIGINT:
            raise


def _on_a_page(stores: "Iterable[Location]", interval: float) -> None:
    try:
        from linksweep.sweep.report.watch import serve
    except ImportError as error:
        raise click.UsageError(f"a page needs more packages: pip install 'linksweep[report]' ({error})") from error
    serve(stores, interval, lambda address: click.echo(f"{address}\nCtrl-C ends it", err=True))


def _in_the_terminal(stores: "Iterable[Location]", interval: float) -> None:
    from rich.console import Console, Group
    from rich.live import Live

    from linksweep.sweep.running.status import Watched, pause

    seen, console = [Watched(store) for store in stores], Console(file=getattr(sys.stdout, "unescaped", sys.stdout))
    with Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext() as live:
        while True:
            begun = time.process_time()
            for one in seen:
                one.look()
            lines = Group(*(line for one in seen for line in _lines(one, console.width)))
            console.print(lines) if live is None else live.update(lines, refresh=True)
            if live is None or all(one.is_over for one in seen):
                break
            time.sleep(pause(interval, time.process_time() - begun))
    if any(one.state == "unreadable" for one in seen):
        sys.exit(group.EXIT_BAD_INPUT)


def _lines(one: "Watched", width: int) -> "Iterable[Text]":
    """Yield what a terminal shows of a store."""
    from rich.text import Text

    from linksweep.sweep.running.failures import NAMED, short

    yield Text(harmless(f"{one.title} ({one.location}): {one.state}"), COLOURS.get(one.state, "bold"))
    yield Text(harmless(", ".join(filter(None, [one.progress, one.speed, one.words]))))
    for row in one.tiles(MOST_ROWS * width, width):
        times = 2 if 2 * len(row) <= width else 1
        yield Text.assemble(*((times * _mark(tile), COLOURS.get(tile.state, "dim")) for tile in row))
    for points, record in one.reasons[:NAMED]:
        line = f"{counted(points, 'point')} failed: {short(record['message'])}, for example at {record['place']}"
        yield Text(harmless(line), "red")


def _mark(tile: "Tile") -> str:
    return PARTLY[int(tile.share * 0.999 * len(PARTLY))] if tile.state == "running" else MARKS.get(tile.state, " ")
