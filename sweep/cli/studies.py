"""Commands that list what there is and help to begin a study: list, params and new."""

import json
from contextlib import suppress
from pathlib import Path

import click

from linksweep.sweep.cli.group import main
from linksweep.sweep.cli.options import json_option
from linksweep.sweep.cli.output import print_styled
from linksweep.sweep.formatting import WIDTH, to_json


@main.command("list")
@json_option
def list_studies(as_json: bool) -> None:
    """List the built-in studies: the title and question of each, and its answer where it was run in this directory.

    \b
    sweep list
    """
    import tomllib

    from linksweep.sweep.studies.document import built_in_studies

    studies = {}
    for name, path in built_in_studies().items():
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        studies[name] = {key: document.get(key, "") for key in ("title", "question")} | {"answer": _answer(name)}
    if as_json:
        click.echo(to_json(studies))
        return
    for name, study in studies.items():
        print_styled(name, bold=True)
        click.echo(_indented(study["title"]))
        for sentence in study["answer"] or [study["question"]]:
            click.echo(_indented(sentence))


def _indented(text: str) -> str:
    return click.wrap_text(text, WIDTH, "    ", "    ")


def _answer(name: str) -> list[str]:
    """Return the answer of a study from its store in the default place; none without one that can be read."""
    from linksweep.sweep.stores.named import default_store

    if not default_store(name).exists():
        return []
    from linksweep.sweep.analysis.answer import answer_in_short, completeness
    from linksweep.sweep.contract import SweepError
    from linksweep.sweep.stores.store import open_dataset

    try:
        dataset = open_dataset(default_store(name))
        return [*completeness(dataset)[:1], *answer_in_short(dataset)]
    except SweepError as error:
        return [f"Its store cannot be read: {'; '.join(error.problems)}"]


@main.command()
@click.argument("experiment", default="linksweep.core.experiment:link")
@click.option("--schema", is_flag=True, help="Print the JSON Schema of studies, by which editors complete them.")
@json_option
def params(experiment: str, schema: bool, as_json: bool) -> None:
    """List the parameters of EXPERIMENT (module:attribute, file.py:attribute, or a study of it) with unit,
    default, allowed values and meaning.

    \b
    sweep params
    sweep params quasars
    sweep params my_experiment.py:experiment
    sweep params --schema > study.schema.json
    """
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.studies.document import built_in_studies
    from linksweep.sweep.studies.reader import load_study

    is_study = experiment.endswith(".toml") or experiment in built_in_studies()
    declared = load_study(experiment).experiment if is_study else load_experiment(experiment)
    if schema:
        from linksweep.sweep.studies.template import study_schema

        click.echo(json.dumps(study_schema(declared), indent=1, ensure_ascii=False))
        return
    rows = [
        {"name": p.name, "unit": p.unit, "default": p.default, "allowed": p.allowed(), "meaning": p.meaning}
        for p in declared.parameters
    ]
    if as_json:
        click.echo(to_json(rows))
        return
    for row in rows:
        default = "see below" if row["default"] is None else row["default"]
        unit = f" [{row['unit']}]" if row["unit"] else ""
        click.echo(f"{row['name']}{unit}  default: {default}")
        click.echo(_indented(f"{row['meaning']}; {row['allowed']}"))


@main.command()
@click.argument("name")
@click.argument("experiment", default="linksweep.core.experiment:link")
def new(name: str, experiment: str) -> None:
    """Write NAME.toml, a study of EXPERIMENT to start from: it runs as it is, and has every parameter in a comment.

    \b
    sweep new mine
    sweep new mine my_experiment.py:experiment
    """
    from linksweep.sweep.code.load import load_experiment
    from linksweep.sweep.contract import SweepError, shown
    from linksweep.sweep.studies.reader import GOOD_NAME
    from linksweep.sweep.studies.template import new_study

    if not GOOD_NAME.fullmatch(name):
        raise SweepError(
            f"{shown(name)} is no name for a study: letters, digits and _ . + -, at most 60; a letter first"
        )
    path = Path(f"{name}.toml")
    text = new_study(name, experiment, load_experiment(experiment)).encode(errors="replace")
    try:
        with path.open("xb") as file:
            file.write(text)
    except FileExistsError as error:
        raise SweepError("exists already; take another name", str(path)) from error
    except OSError as error:
        with suppress(OSError):
            path.unlink()
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    click.echo(f"wrote {path}; edit it, then: sweep plan {path}", err=True)
