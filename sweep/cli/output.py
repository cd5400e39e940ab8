"""Prints the results of commands: tables in their full width, sentences, figures."""

import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from linksweep.sweep.formatting import WIDTH, harmless


def print_sentences(sentences: Iterable[str]) -> None:
    """Print each sentence in lines of the width of a terminal."""
    for sentence in sentences:
        click.echo(click.wrap_text(sentence, WIDTH))


def print_styled(text: str, **style: bool) -> None:
    """Print text in a style of ours, which it cannot change."""
    click.secho(harmless(text), file=getattr(sys.stdout, "unescaped", None), **style)


def print_whole(renderable: Any) -> None:
    """Print a table or text as wide as it is: a terminal may wrap it, but no number is cut.  The title of a table is a
    sentence above it.
    """
    from rich.console import Console
    from rich.measure import Measurement
    from rich.segment import Segment, Segments
    from rich.table import Table

    if isinstance(renderable, Table) and renderable.title is not None:
        title, renderable.title = str(renderable.title), None
        if title:
            print_styled(click.wrap_text(title, WIDTH), italic=True)
    terminal = Console(file=getattr(sys.stdout, "unescaped", None), highlight=False, markup=False, emoji=False)
    endless = terminal.options.update(width=10_000)
    needed = Measurement.get(terminal, endless, renderable).maximum
    terminal.width = max(needed, terminal.width if sys.stdout.isatty() else 1)
    segments = terminal.render(terminal.render_str(renderable) if isinstance(renderable, str) else renderable)
    terminal.print(Segments(Segment(harmless(segment.text), segment.style) for segment in segments))


def table_width() -> int:
    """Return how wide a table may be: as the terminal, or `WIDTH` where there is none or it is narrower."""
    return max(WIDTH, shutil.get_terminal_size((WIDTH, 0)).columns) if sys.stdout.isatty() else WIDTH


def print_table(dataset: Any, table_format: str, with_components: bool = False) -> None:
    """Print the results of a dataset, the components of some points if they are wanted, and warnings."""
    from linksweep.sweep.analysis import components, headline_table, long_table
    from linksweep.sweep.analysis.columns import left_out_in_words
    from linksweep.sweep.analysis.gaps import lacking

    if table_format != "text":
        write = {"csv": long_table.as_csv, "ecsv": long_table.as_ecsv, "json": long_table.as_json}[table_format]
        click.echo(write(dataset).rstrip("\n"))
        return
    width = table_width()
    table, folded = headline_table.as_text(dataset, width)
    print_whole(table)
    for one in headline_table.errors_as_text(dataset) if with_components else ():
        click.echo()
        print_whole(one)
    if with_components and (lines := components.component_lines(dataset)):
        click.echo("\n".join(["", *lines, ""]))
    warnings = filter(None, [*headline_table.warnings_of(dataset), components.condition_warning(dataset)])
    print_sentences(f"warning: {sentence}" for sentence in warnings)
    print_sentences([*headline_table.arrays_in_words(dataset), *headline_table.exactly_published(dataset)])
    if folded:
        print_sentences([f"left out to fit {width} columns: {left_out_in_words(folded)}; --format csv has them"])
    if left_out := headline_table.rows_left_out(dataset):
        click.echo(f"{left_out:,} more points: `sweep show STORE --format csv` has all of them")
    if words := lacking(dataset):
        click.echo(f"INCOMPLETE: {words}")


def drawing_styles() -> Any:
    """Return `linksweep.sweep.plots.style`; raises click.UsageError where matplotlib, which it needs, is missing."""
    try:
        from linksweep.sweep.plots import style
    except ImportError as error:
        raise click.UsageError(f"drawing needs matplotlib: pip install 'linksweep[plot]' ({error})") from error
    return style


def save_figure(dataset: Any, path: Path) -> None:
    """Draw a dataset into a file, in the way that suits it."""
    from linksweep.sweep.plots import style
    from linksweep.sweep.plots.figure import draw_figure

    with style.settings():
        style.save(draw_figure(dataset), path)
