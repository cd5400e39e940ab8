"""The command group: turns what goes wrong in any command into a message and an exit code."""

import atexit
import gc
import sys
from collections.abc import Sequence
from typing import Any

import click

from linksweep.sweep.cli.streams import harmless_streams, output_problem
from linksweep.sweep.formatting import COMMAND

EXIT_FAILED_POINTS = 1
EXIT_BAD_INPUT = 2

atexit.register(gc.freeze)  # else Python searches all imports for garbage at the end, which takes a fifth of a second

SECTIONS = {
    "Run": {
        "run": "Run a study into a store; print table and answer",
        "plan": "Say what a run would do, and write nothing",
        "scaling": "Measure how a study scales with workers",
    },
    "Look": {
        "list": "List the built-in studies and their answers",
        "show": "Print results as a table, CSV, ECSV or JSON",
        "plot": "Draw results",
        "report": "Write one HTML page with everything",
        "fit": "Fit a law along an axis",
        "find": "Find where a condition is met along an axis",
        "sensitivity": "Say which parameters decide a result",
    },
    "Compare": {
        "compare": "Compare with published numbers and claims",
    },
    "Store care": {
        "status": "Say how far a run is, and what failed",
        "check": "Compare files with checksums; set damaged aside",
        "reproduce": "Compute points again, to the bit",
        "merge": "Make one store of two of the same experiment",
    },
    "Your own": {
        "new": "Write a commented study to start from",
        "params": "List the parameters of a study or experiment",
        "tie": "Solve for the link of two real tables",
        "forecast": "Forecast a link with new observations",
        "match": "Find the galaxies in a star catalogue",
    },
}
"""The commands as the help lists them."""


class _Group(click.Group):
    """Lists its commands by what they are for; turns a SweepError of any command into one message and exit code 2, and
    a signal into exit code 128 plus its number.
    """

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl(list(commands.items()), col_spacing=max(2, 12 - max(map(len, commands))))

    def main(self, args: Sequence[str] | None = None, *further: Any, **named: Any) -> Any:
        before, COMMAND[:] = COMMAND[:], ["sweep", *(sys.argv[1:] if args is None else args)]
        with harmless_streams():
            try:
                return super().main(args, *further, **named)
            except SystemExit as end:
                if (problem := output_problem()) is None:
                    raise
                click.echo(f"error: {problem}", err=True)
                sys.exit(end.code or EXIT_BAD_INPUT)
            finally:
                COMMAND[:] = before

    def invoke(self, ctx: click.Context) -> Any:
        from linksweep.sweep.cli.signals import end_stopped
        from linksweep.sweep.interrupt import RunInterruptedError, how_ended, watched

        try:
            with watched():  # click itself would end with 1, which means that points failed
                return self._invoke(ctx)
        except RunInterruptedError as stop:
            click.echo(how_ended(stop.signal.name), err=True)
            end_stopped(stop.signal)

    def _invoke(self, ctx: click.Context) -> Any:
        from linksweep.sweep.contract import SweepError

        try:
            return super().invoke(ctx)
        except SweepError as error:
            where = f"{error.where}: " if error.where else ""
            if len(error.problems) == 1:
                click.echo(f"error: {where}{error.problems[0]}", err=True)
            else:
                click.echo(f"error: {where}{len(error.problems)} problems", err=True)
                for problem in error.problems:
                    click.echo(f"  - {problem}", err=True)
            sys.exit(error.exit_code)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="linksweep", prog_name="linksweep")
def main() -> None:
    """Sweep Monte-Carlo simulations of a satellite's link to the extragalactic frame.

    \b
    sweep run quasars        the paper's Table 1, beside the published one
    sweep list               the other built-in studies
    sweep new mine           a study of your own to start from
    """
