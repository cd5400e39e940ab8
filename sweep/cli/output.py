"""Prints the results of commands: tables in their full width, JSON, sentences."""

import shutil
import sys
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING, Any

import click

from linksweep.sweep.formatting import WIDTH, counted, harmless, in_words

if TYPE_CHECKING:
    from linksweep.sweep.stores.location import Location
    from linksweep.sweep.studies.study import Study

MOST_FAILURES = 20
"""Most failed points that `sweep status` names in a terminal."""


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


def print_plan(report: dict[str, Any]) -> None:
    """Print what a run would do."""
    for key, text in (*_plan_in_words(report).items(), *(("warning", text) for text in report["warnings"])):
        click.echo(click.wrap_text(text, WIDTH, f"{key:14}", 14 * " "))


def _plan_in_words(report: dict[str, Any]) -> dict[str, str]:
    from linksweep.sweep.running.failures import failed_before

    failed = failed_before(report["points_failed"])
    words = {
        "study": report["title"],
        "grid": report["grid"],
        "points": f"{report['points']:,}, {report['points_done']:,} of them done{failed}",
    }
    if "realisations" in report:
        done = report["realisations"] - report["realisations_pending"]
        words["realisations"] = f"{report['realisations']:,}, {done:,} of them done"
    tasks = f" in about {counted(report['tasks_about'], 'task')}" if report["tasks_about"] else ""
    words["work"] = f"{counted(report['blocks_pending'], 'block')}{tasks}"
    words["memory"] = (
        f"{report['memory_mb']:,.3g} MB: {report['result_mb']:,.3g} MB of results, "
        f"{report['ledger_mb']:,.3g} MB of ledger"
    )
    if "seconds" in report:
        cores = f"{report['cores']} core{'' if report['cores'] == 1 else 's'}"
        words["time"] = f"at least {in_words(report['seconds'])} of computing on {cores} of this machine"
    return words | {"store": report["store"]}


def print_table(dataset: Any, table_format: str, with_components: bool = False) -> None:
    """Print the results of a dataset, the components of some points if they are wanted, and warnings."""
    from linksweep.sweep.analysis import components, headline_table, long_table
    from linksweep.sweep.analysis.columns import left_out_in_words
    from linksweep.sweep.analysis.gaps import lacking

    if table_format == "text":
        width = table_width()
        table, folded = headline_table.as_text(dataset, width)
        print_whole(table)
        for one in headline_table.errors_as_text(dataset) if with_components else ():
            click.echo()
            print_whole(one)
        if with_components and (lines := components.component_lines(dataset)):
            click.echo("\n".join(["", *lines, ""]))
        told = filter(None, [*headline_table.warnings_of(dataset), components.condition_warning(dataset)])
        print_sentences(f"warning: {sentence}" for sentence in told)
        print_sentences([*headline_table.arrays_in_words(dataset), *headline_table.exactly_published(dataset)])
        if folded:
            print_sentences([f"left out to fit {width} columns: {left_out_in_words(folded)}; --format csv has them"])
        if left_out := headline_table.rows_left_out(dataset):
            click.echo(f"{left_out:,} more points: `sweep show STORE --format csv` has all of them")
        if words := lacking(dataset):
            click.echo(f"INCOMPLETE: {words}")
    else:
        write = {"csv": long_table.as_csv, "ecsv": long_table.as_ecsv, "json": long_table.as_json}[table_format]
        click.echo(write(dataset).rstrip("\n"))


def print_verified(study: "Study", store: "Location", points: int, shown: bool = True) -> bool:
    """Compute some points of a store again, and say to standard error which differ; return whether any does.  That none
    does is only said if ``shown``.
    """
    from linksweep.sweep.running.verify import verify

    found = verify(study, store, points)
    for sentence in found.differing:
        click.echo(f"differs: {harmless(sentence)}", err=True)
    if shown and not found.differing:
        again = counted(found.points, "point")
        click.echo(f"{again} computed again, alone and in two orders: every bit as in {store}", err=True)
    return bool(found.differing)


def print_answer(dataset: Any) -> None:
    """Print the answer to the study's question, in lines of the width of a terminal."""
    from linksweep.sweep.analysis.answer import answer_in_short

    print_sentences(answer_in_short(dataset))


def print_comparisons(comparisons: Any, remarks: list[str], table_format: str) -> None:
    """Print a comparison with published numbers, its remarks, and how many have each verdict."""
    from linksweep.sweep.analysis import compare_tables

    if table_format == "json":
        click.echo(compare_tables.as_json(comparisons, remarks))
        return
    if table_format == "csv":
        click.echo(compare_tables.as_csv(comparisons).rstrip("\n"))
        for sentence in remarks:
            click.echo(sentence, err=True)
        return
    if comparisons:
        from linksweep.sweep.analysis.compare_text import as_text

        print_whole(as_text(comparisons, table_width()))
    print_sentences(remarks)
    click.echo(compare_tables.summary_line(comparisons))


def print_status(report: dict[str, Any]) -> None:
    """Print how far a run is."""
    from linksweep.sweep.running.progress import axis_table

    for key, value in report.items():
        if key == "axes":
            for dimension in value.values():
                click.echo()
                print_whole(axis_table(dimension, report["units"]))
            click.echo(nl=bool(value))
        elif key == "units":
            continue
        elif key == "failures":
            _print_failures(value)
        elif isinstance(value, dict):
            click.echo(f"{key}:")
            for name, text in value.items():
                click.echo(click.wrap_text(f"{name}: {text}", WIDTH, "  ", "    "))
        else:
            click.echo(click.wrap_text(f"{key}: {value}", WIDTH, "", "  "))


def _print_failures(failures: dict[str, str]) -> None:
    """Print why points failed: each of a few, else the reasons with their counts, and the first points."""
    from linksweep.sweep.running.failures import failed_points

    click.echo("failures:")
    if len(failures) > MOST_FAILURES:
        click.echo(click.wrap_text(failed_points(failures), WIDTH, "  ", "    "))
    for place, message in islice(failures.items(), MOST_FAILURES):
        click.echo(click.wrap_text(f"{place}: {message}", WIDTH, "  ", "    "))
    if len(failures) > MOST_FAILURES:
        click.echo(f"  {len(failures) - MOST_FAILURES:,} more points: `sweep status STORE --json` has all of them")
