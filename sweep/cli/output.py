"""Prints the results of commands: tables in their full width, sentences, figures."""

import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.formatting import WIDTH, harmless

if TYPE_CHECKING:
    from linksweep.sweep.table_writer import Table


def print_sentences(sentences: Iterable[str]) -> None:
    """Print each sentence in lines of the width of a terminal."""
    for sentence in sentences:
        click.echo(click.wrap_text(sentence, WIDTH))


def print_styled(text: str, **style: bool) -> None:
    """Print text in a style of ours, which it cannot change."""
    click.secho(harmless(text), file=getattr(sys.stdout, "unescaped", None), **style)


def print_tables(tables: "Iterable[Table]", notes: Iterable[str] = ()) -> None:
    """Print tables with the columns for which there is room, and sentences below them; no number is cut."""
    width = table_width()
    for number, table in enumerate(tables):
        kept, left_out = table.fitting(width)
        text = kept.text(width, styled=True)
        click.echo(f"\n{text}" if number else text, file=getattr(sys.stdout, "unescaped", None))
        if left_out:
            print_sentences([f"left out to fit {width} columns: {left_out}; --json has them"])
    print_sentences(notes)


def print_result(dataset: Any, table_format: str) -> None:
    """Print results of any kind: their tables and notes, or their table for programs."""
    from linksweep.sweep.result import Result

    result = Result(dataset)
    if table_format == "text":
        notes = result.notes()
        print_tables(result.tables(), ["", *notes] if notes else ())
    else:
        click.echo(result.written(table_format).rstrip("\n"))


def table_width() -> int:
    """Return how wide a table may be: as the terminal, or `WIDTH` where there is none or it is narrower."""
    return max(WIDTH, shutil.get_terminal_size((WIDTH, 0)).columns) if sys.stdout.isatty() else WIDTH


def print_headlines(dataset: Any, table_format: str) -> None:
    """Print the headline results of a study and what is to be said about them, or all results for programs."""
    from linksweep.sweep.analysis.results_table import headline_table, notes

    if table_format == "text":
        print_tables([headline_table(dataset)], notes(dataset))
    else:
        print_result(dataset, table_format)


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
