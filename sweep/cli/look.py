"""Commands that look at results: list, show, plot, report, fit, find, sensitivity, compare and watch."""

import signal
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import linksweep
from linksweep.sweep import cli, studies as known
from linksweep.sweep.cli import AT, JSON, STORE, At, arg, choice, flag, many, opt, parsed, part_of
from linksweep.sweep.cli.run import Running, Target, Watching, resources, run_with_progress
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.formatting import counted, harmless, to_json
from linksweep.sweep.interrupt import RunInterruptedError, watched
from linksweep.sweep.plots import ALL_KINDS, KINDS

if TYPE_CHECKING:
    from rich.text import Text

    from linksweep.sweep.running.status import Tile, Watched
    from linksweep.sweep.stores.location import Location

KIND_HELP = f"What to draw: {', '.join(ALL_KINDS)}.  [default: what suits the results]"
PERCENT = click.FloatRange(0.0, 100.0, min_open=True, max_open=True)
LAWS = "power: variable ~ over^p; levelling: variable^2 = plateau^2 + c exp(-rate x over)."

# The studies of Metz & Geffert 2004, by section; all others follow, sorted by name.
PAPER_ORDER = (
    *("algorithm", "error-surface", "sqrt-n", "scatter", "quasars", "galaxies", "completeness", "mission-length"),
    *("aberration", "radio-stars"),
)


@cli.command("Look", "List the built-in studies and their answers", name="list")
def list_studies(as_json: bool = JSON) -> None:
    """List the built-in studies: the title and question of each, and its answer where it was run in this directory.

    \b
    sweep list
    """
    studies = {}
    for name, document in _built_in().items():
        studies[name] = {key: document.get(key, "") for key in ("title", "question")} | {"answer": _answer(name)}
    if as_json:
        cli.put(to_json(studies))
        return
    for name, study in studies.items():
        cli.print_styled(name, bold=True)
        for sentence in (study["title"], *(study["answer"] or [study["question"]])):
            cli.print_wrapped(sentence, "    ", "    ")


def _built_in() -> dict[str, dict[str, Any]]:
    """Return the built-in studies as they are written, by name."""
    import tomllib  # which `sweep --help` does without

    return {name: tomllib.loads(path.read_text("utf-8")) for name, path in known.built_in_studies().items()}


def _answer(name: str) -> list[str]:
    """Return the answer of a study from its store in the default place; none without one that can be read."""
    from linksweep.sweep.stores.location import default_store

    if not default_store(name).exists():
        # Before the imports: most studies of the list were never run here.
        return []
    from linksweep.sweep.analysis.answer import answer_in_short, completeness
    from linksweep.sweep.stores.store import OpenStore

    try:
        dataset = OpenStore(default_store(name)).dataset()
        return [*completeness(dataset)[:1], *answer_in_short(dataset)]
    except linksweep.SweepError as error:
        return [f"Its store cannot be read: {'; '.join(error.problems)}"]


@cli.command("Look", "Print results as a table, CSV, ECSV or JSON")
def show(
    store: "Location" = STORE,
    table_format: str = choice("", ("text", "csv", "ecsv"), "--format", default="text"),
    at: At = AT,
    stars: bool = flag("For a link: a row for each source, with Q/n, Cook's distance, share, jackknife shift."),
    minus: str | None = opt("For a link: its difference from the link in another store.", metavar="STORE"),
    as_json: bool = JSON,
) -> None:
    """Print the results in STORE as a table, with the components of the points that are in the worst condition.
    For a stored link or forecast, print what `sweep tie` or `sweep forecast` printed.

    \b
    sweep show quasars --at model=gaia
    sweep show results/quasars.zarr --format ecsv > quasars.ecsv
    """
    if as_json and table_format != "text":
        raise click.UsageError(f"--json and --format {table_format} are two formats; name one")
    table_format = "json" if as_json else table_format
    if stars or minus is not None:
        from linksweep.sweep.tie.result import difference, of_difference, of_stars

        link: Any = cli.link_in(store, at)
        other: Any = None if minus is None else cli.link_in(minus, ())
        table = of_stars({} if link is None else link) if minus is None else of_difference(difference(link, other))
        cli.put(getattr(table, table_format)().rstrip("\n"))
        return
    # Formats for programs keep excluded points: a column has the status.
    with part_of(store, at, excluded_too=table_format != "text", to_show=True) as part:
        cli.print_result(part, table_format)


@parsed
def _millimetres(text: str) -> float:
    try:
        width = float(text.strip().removesuffix("mm"))
    except ValueError:
        width = 0.0
    if not 40.0 <= width <= 1000.0:
        raise ValueError(f"{text!r}: must be from 40mm to 1000mm, like 88mm or 180mm")
    return width


@dataclass(frozen=True)
class Drawing:
    """What is drawn, as the command line names it."""

    source: str | None = arg(required=False)
    kind: str | None = choice(KIND_HELP, ALL_KINDS, metavar="KIND")
    variables: At = many("The quantity; several become panels.  [default: the main result]", "--variable")
    over: At = many("The axis to draw along; give both for a map, or two components of a scatter.")
    log: At = many("Give this axis or quantity a logarithmic axis.", metavar="NAME")
    linear: At = many("Give it a linear axis.  [default: by the spacing of the values]", metavar="NAME")
    models: At = many("Accuracy: only this mission; may be given several times.", "--model")
    at: At = AT

    def __post_init__(self) -> None:
        """Raise click.UsageError for options that do not go with the kind."""
        if self.source is None and self.kind != "accuracy":
            raise click.UsageError("name the store to draw; only --kind accuracy is drawn without one")
        if self.models and self.kind != "accuracy":
            raise click.UsageError("--model goes with --kind accuracy; choose a part of a store with --at model=NAME")
        if self.kind in KINDS["catalogue"] and (self.variables or self.over or self.log or self.linear):
            raise click.UsageError(f"--variable, --over, --log and --linear do not go with --kind {self.kind}")

    def figure(self) -> tuple[Any, Any]:
        """Return a figure, and the dataset that it shows."""
        from linksweep.sweep.plots import figure as figures, link as sky
        from linksweep.sweep.running.reproduce import study_to_look_at
        from linksweep.sweep.stores.location import store_named

        if self.kind == "accuracy":
            study = None
            if self.source is not None:
                is_file = self.source.endswith(".toml")
                study = linksweep.load_study(self.source) if is_file else study_to_look_at(store_named(self.source))
            curves = sky.accuracy_curves(self.models, study)
            return sky.accuracy_figure(curves), curves
        assert self.source is not None, "asked for before"
        store = store_named(self.source)
        if self.kind == "sky":
            objects = sky.catalogue_of_point(store, self.at)
            return sky.sky_figure(objects), objects
        with part_of(store, self.at, to_show=True) as dataset:
            return figures.draw_figure(dataset, self.kind, self.variables, self.over, self.log, self.linear), dataset


@cli.command("Look", "Draw results")
def plot(
    drawn: Drawing = cli.group(Drawing),
    width: float | None = opt("How wide it is printed, e.g. 88mm or 180mm.", metavar="MM", callback=_millimetres),
    style: str | None = choice("Sizes of letters and lines.  [default: paper]", ("paper", "talk")),
    caption: bool = flag("Write NAME.txt beside the picture: caption and alternative text."),
    output: Path | None = cli.output("Picture to write: .png, .svg or .pdf.  [default: NAME.png]"),
) -> None:
    """Draw the results in SOURCE, a store, in the way that suits them: curves with errors, prediction and published
    values, small panels, a map, a fitted law, a scatter of kept samples.  For a link or a forecast of real tables there
    are the kinds from solution on in the list below.

    \b
    sweep plot quasars --width 88mm --caption -o quasars.pdf
    sweep plot results/grid.zarr --over n_obj --at error_scale=1
    sweep plot grid --kind map --over n_obj --over v_max --at model=gaia
    sweep plot results/quasars.zarr --kind sky --at model=gaia,v_max=16
    sweep plot --kind accuracy --model amex --model gaia
    sweep plot mission.toml --kind accuracy
    sweep plot tie.zarr --kind residuals -o residuals.png
    """
    styles = cli.drawing_styles()
    path = output or Path(Path(drawn.source or "accuracy").stem + ".png")
    # Before a large store is read and drawn.
    styles.require_format(path)
    with styles.settings(width, style):
        figure, dataset = drawn.figure()
        styles.save(figure, path, styles.caption_and_description(figure, dataset) if caption else "")
    for written in (path, path.with_suffix(".txt"))[: 1 + caption]:
        cli.wrote(written)


def paper_studies(published: bool) -> "list[linksweep.Study]":
    """Return the built-in studies in the order of the paper, or those that have ``published`` numbers or claims."""
    names = [name for name, text in _built_in().items() if not published or {"published", "claim"} & text.keys()]
    others = sorted(set(names).difference(PAPER_ORDER))
    return [linksweep.load_study(name) for name in (*PAPER_ORDER, *others) if name in names]


@dataclass(frozen=True)
class AskedStores:
    """The stores that a command is about: those that it names, or with --all those of the whole paper."""

    stores: "tuple[Location, ...]" = cli.STORES
    everything: bool = flag("All studies with something published; those without results are run.", "--all")
    results: Path | None = opt("Folder with the stores of --all.  [default: results]", type=cli.FILE)
    resources: Resources = cli.group(resources)
    watching: Watching = cli.group(Watching)

    def __post_init__(self) -> None:
        """Raise click.UsageError unless there are either stores or --all, and for options of --all without it."""
        if self.everything == bool(self.stores):
            raise click.UsageError("name stores, or give --all")
        about_runs = self.results, self.resources, self.watching
        if about_runs != (None, Resources(), Watching(False, False, None, None)) and not self.everything:
            raise click.UsageError("--results, what to run on and how to watch it go with --all: nothing runs without")

    def whole(self, published: bool = False) -> "Sequence[Location]":
        """Return the stores; with --all, first run the studies: all, or those with something published.  One that is
        finished takes no time.

        Raises SweepError, before anything runs, for a study whose store cannot be continued.
        """
        if not self.everything:
            return self.stores
        from linksweep.sweep.running.run import plan_study
        from linksweep.sweep.stores.location import RESULTS, located

        places = []
        for study in paper_studies(published):
            store = located((self.results or RESULTS) / f"{study.name}.zarr")
            # All stores are looked at before the first study runs: an hour later is late for a refusal.
            try:
                plan_study(study, store)
            except linksweep.SweepError as error:
                if not all("pip install" in problem for problem in error.problems):
                    raise
                click.echo(f"left out: {study.name}: {error.problems[0]}", err=True)
            else:
                places.append((study, store))
        for study, store in places:
            if not self.watching.quiet:
                click.echo(f"{study.name}:", err=True)
            run_with_progress(study, store, Running(self.resources, self.watching, None, False, False, None))
        return [store for _, store in places]


_pages = partial(cli.with_extra, "report", "more packages", "report.page")


@cli.command("Look", "Write one HTML page with everything")
def report(
    asked: AskedStores = cli.group(AskedStores),
    output: Path | None = cli.output("The page; replaces an earlier report.  [default: NAME-report.html]"),
) -> None:
    """Write one HTML page about the results in STORE: the answer, figures, tables, an interactive view, a comparison
    with published numbers, and where everything comes from.

    The page needs no network and no server.

    \b
    sweep report results/quasars.zarr
    sweep report --all -o paper.html
    """
    page = _pages()
    path = output or (Path("paper-report.html") if asked.everything else page.default_path(asked.stores))
    page.check_output(path)
    page.write_report(page.report_of(asked.whole()), path)
    cli.wrote(path)


@cli.command("Look", "Fit a law along an axis")
def fit(
    store: "Location" = STORE,
    over: str | None = opt("The axis to fit along.  [default: the only one with several numbers]"),
    variable: str | None = opt("What to fit.  [default: the main result]"),
    law: str = choice(LAWS, ("power", "levelling"), default="power"),
    expect: float | None = opt("Exponent to test.  [default: that of a claim of the study]", type=float),
    fall: float | None = opt(
        "Levelling: find where it falls by less per unit.  [default: 5]", type=PERCENT, metavar="PERCENT"
    ),
    at: At = AT,
    as_json: bool = JSON,
) -> None:
    """Fit a law to a result in STORE along an axis, for every combination of the other axes.

    Points are weighted by their Monte-Carlo errors, and by their covariance if they share random numbers.

    \b
    sweep fit results/sqrt-n.zarr --over n_obj --expect -0.5
    sweep fit results/mission-length.zarr --over mission_length --at model=gaia
    sweep fit results/quasars.zarr --over v_max --law levelling
    """
    from linksweep.sweep.analysis import quantity

    if law == "levelling" and expect is not None:
        raise click.UsageError("--expect is an exponent and goes with --law power")
    if law == "power" and fall is not None:
        raise click.UsageError("--fall goes with --law levelling")
    with part_of(store, at) as dataset:
        variable = variable or quantity.main_quantity(dataset)
        over = quantity.require_axis(dataset, variable, over)
        if law == "power":
            result = linksweep.fit_power_law(dataset, variable, over, expect)
        else:
            result = linksweep.fit_levelling(dataset, variable, over, (fall or 5.0) / 100.0)
    cli.print_result(result, "json" if as_json else "text")


@cli.command("Look", "Find where a condition is met along an axis")
def find(
    store: "Location" = STORE,
    where: str = opt("VARIABLE, one of < <= > >=, NUMBER and unit.", required=True, metavar="CONDITION"),
    over: str | None = opt("The axis to look along.  [default: the only one with several numbers]"),
    at: At = AT,
    as_json: bool = JSON,
) -> None:
    """Find where in STORE a condition is met along an axis, for every combination of the other axes.

    Between the points of the grid the crossing is interpolated, with the error that follows from theirs.  For a table
    or a design, whose points are in no order, the points that meet the condition are listed.

    \b
    sweep find results/quasars.zarr --where "sigma_spin < 1 uas/yr" --over v_max
    sweep find grid --where "sigma_spin <= 0.5" --over n_obj --at model=amex
    """
    from linksweep.sweep.analysis import laws, quantity

    limit = laws.parse_limit(where)
    with part_of(store, at) as dataset:
        if over is None and len(quantity.varied_parameters(dataset)) > 1:
            met, doubt = laws.points_where(dataset, limit)
            if as_json or met["status"].size:
                cli.print_headlines(met, as_json)
            none = "" if met["status"].size else f"no point meets {limit}"
            if (words := "; ".join(filter(None, (none, doubt)))) and not as_json:
                cli.put(words)
            return
        result = laws.find(dataset, limit, quantity.require_axis(dataset, limit.variable, over))
    cli.print_result(result, "json" if as_json else "text")


@cli.command("Look", "Say which parameters decide a result")
def sensitivity(
    store: "Location" = STORE,
    variable: str | None = opt("What varies.  [default: the main result]"),
    at: At = AT,
    target: Target = cli.group(Target),
) -> None:
    """Estimate how much of the variance of a result in STORE is due to each parameter, with errors.

    First-order and total Sobol indices of full grids and of saltelli designs, effects of morris designs, first-order
    indices of any other points.

    \b
    sweep sensitivity results/sir.zarr
    sweep sensitivity results/sir.zarr --variable peak -o peak.png
    """
    with part_of(store, at) as dataset:
        result = linksweep.sensitivity(dataset, variable)
    target.put(result)


@cli.command("Compare", "Compare with published numbers and claims")
def compare(
    asked: AskedStores = cli.group(AskedStores),
    as_json: bool = JSON,
) -> None:
    """Compare the results in STORE with the published numbers and claims of its study.

    The exit code is 1 if something is not reproduced or incomplete.

    \b
    sweep compare results/quasars.zarr
    sweep compare --all --workers 4
    """
    from linksweep.sweep.analysis import compare as verdicts

    comparisons, remarks = [], []
    for store in asked.whole(published=True):
        with part_of(store, ()) as dataset:
            some, about = verdicts.compare(dataset), verdicts.remarks(dataset)
            if not some and not about:
                why = "its study has neither published numbers nor claims to compare with"
                raise linksweep.SweepError(why, str(store))
            if overrides := dataset.attrs.get("study_overrides"):
                about = [f"the study was changed on the command line: {overrides}", *about]
        comparisons += some
        remarks += [f"{store}: {sentence}" for sentence in about]
    if as_json:
        cli.put(verdicts.as_json(comparisons, remarks))
    else:
        below = [*verdicts.notes(comparisons), *remarks, verdicts.summary_line(comparisons)]
        cli.print_tables(verdicts.tables(comparisons), ["", *below])
    if not verdicts.all_is_well(comparisons):
        sys.exit(cli.EXIT_FAILED_POINTS)


# Rows of tiles in a terminal.
MOST_ROWS = 12

COLOURS = {"running": "cyan", "done": "green", "finished": "green", "failed": "bold red", "stopped": "yellow"}
MARKS = {"done": "█", "failed": "×", "waiting": "·"}
# Marks of a tile that is running, by how much of it is done.
PARTLY = "▁▂▃▄▅▆▇"


@cli.command("Look", "Watch runs: points, speed, failures; --web: a page")
def watch(
    stores: "tuple[Location, ...]" = cli.STORES,
    web: bool = flag("Show figures too, on a page that only this machine can open."),
    interval: float = opt("Seconds between looks.", type=click.FloatRange(0.2, 3600.0), default=2.0),
) -> None:
    """Watch the runs in STORE, which may begin later: a tile for each point, speed and time left, reasons of failures.

    Any machine that can read the stores can watch; nothing is written. It ends when all runs have ended; with --web, or
    while a store is not there yet, at Ctrl-C. If standard output is not a terminal, they are shown once.

    \b
    sweep watch quasars
    sweep watch results/quasars.zarr s3://bucket/grid.zarr --web
    """
    if not stores:
        raise click.UsageError("name a store")
    try:
        with watched():
            if web:
                _pages().serve(stores, interval, lambda address: click.echo(f"{address}\nCtrl-C ends it", err=True))
            else:
                _in_the_terminal(stores, interval)
    except RunInterruptedError as stop:
        # Ctrl-C is how one stops watching; any other signal came from elsewhere.
        if stop.signal != signal.SIGINT:
            raise


def _in_the_terminal(stores: "Iterable[Location]", interval: float) -> None:
    from rich.console import Console, Group
    from rich.live import Live

    from linksweep.sweep.running.status import Watched, pause

    seen, console = [Watched(store) for store in stores], Console(file=cli.RESULTS[0].unescaped)
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
        sys.exit(cli.EXIT_BAD_INPUT)


def _lines(one: "Watched", width: int) -> "Iterable[Text]":
    """Yield what a terminal shows of a store."""
    from rich.text import Text

    from linksweep.sweep.running.progress import NAMED, short

    yield Text(harmless(f"{one.title} ({one.location}): {one.state}"), COLOURS.get(one.state, "bold"))
    yield Text(harmless(", ".join(filter(None, [one.progress, one.speed, one.words]))))
    for row in one.tiles(MOST_ROWS * width, width, MOST_ROWS):
        times = 2 if 2 * len(row) <= width else 1
        yield Text.assemble(*((times * _mark(tile), COLOURS.get(tile.state, "dim")) for tile in row))
    for points, place, record in one.reasons[:NAMED]:
        line = f"{counted(points, 'point')} failed: {short(record['message'])}, for example at {place}"
        yield Text(harmless(line), "red")


def _mark(tile: "Tile") -> str:
    return PARTLY[int(tile.share * 0.999 * len(PARTLY))] if tile.state == "running" else MARKS.get(tile.state, " ")
