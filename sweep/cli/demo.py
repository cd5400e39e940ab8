"""The command that shows the whole way from a study to its answer: demo."""

import shlex
from contextlib import chdir
from importlib.util import find_spec
from pathlib import Path

import click

from linksweep.sweep.cli.group import main
from linksweep.sweep.cli.options import FILE
from linksweep.sweep.cli.output import print_answer, print_styled
from linksweep.sweep.formatting import WIDTH

STUDY = Path(__file__).with_name("demo.toml")

STEPS = {
    "sweep plan demo.toml": "What a run would do, before anything is computed.",
    "sweep run demo.toml": "Run it. After an interruption the same command goes on where it stopped.",
    "sweep show demo --at model=gaia": "The results of one mission.",
    "sweep plot demo -o demo.png": "A figure: points are simulated, lines predicted in closed form.",
    "sweep report demo -o demo.html": "One page with everything, to look at in a browser.",
}
"""The commands, and what each is for."""

NEXT = {
    "sweep run demo.toml --axis v_max=14:20:0.5": "only what is new is computed",
    "sweep new mine": "a study of your own",
    "sweep list": "the studies of a paper",
}

NEEDS = {"plot": ("matplotlib",), "report": ("matplotlib", "bokeh", "jinja2")}
"""Packages that commands need; without them these steps are left out."""


@main.command()
@click.argument("folder", type=FILE, default="linksweep-demo")
@click.pass_context
def demo(context: click.Context, folder: Path) -> None:
    """Show the whole way from a study to its answer, in less than a minute: write a small study into a new FOLDER
    (linksweep-demo unless given), then plan, run, show, plot and report it.

    Every command is shown before it runs, and can be typed again.

    \b
    sweep demo
    """
    from linksweep.sweep.stores.named import default_store
    from linksweep.sweep.stores.store import open_dataset

    text = STUDY.read_text(encoding="utf-8")
    _write(folder, text)
    print_styled(f"The study, {folder / 'demo.toml'}:", bold=True)
    click.echo(text)
    _say(f"cd {shlex.quote(str(folder))}", "All that follows is in this folder.")
    with chdir(folder):
        for line, words in STEPS.items():
            _, name, *arguments = line.split()
            if missing := [package for package in NEEDS.get(name, ()) if find_spec(package) is None]:
                click.echo(f"left out: `{line}` needs {', '.join(missing)}: pip install 'linksweep[report]'\n")
                continue
            _say(line, words)
            command = main.commands[name]
            with command.make_context(name, arguments, parent=context) as inner:
                command.invoke(inner)
            click.echo()
        dataset = open_dataset(default_store("demo"))
    print_styled(click.wrap_text(dataset.attrs["question"], WIDTH), bold=True)
    print_answer(dataset)
    click.echo(f"\nnext: cd {shlex.quote(str(folder))}")
    for line, words in NEXT.items():
        click.echo(f"      {line:44}{words}")


def _write(folder: Path, text: str) -> None:
    """Write the study into a new folder; raises SweepError for one that is there, or that cannot be made."""
    from linksweep.sweep.contract import SweepError

    try:
        folder.mkdir(parents=True)
        (folder / "demo.toml").write_text(text, encoding="utf-8")
    except FileExistsError as error:
        raise SweepError("exists already; nothing is overwritten, take another name", str(folder)) from error
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(folder)) from error


def _say(line: str, words: str) -> None:
    print_styled(f"# {words}", dim=True)
    print_styled(f"$ {line}", bold=True)
