"""Commands that say what there is: list and params."""

import json

import click

from sweep.cli.group import main
from sweep.cli.options import json_option


@main.command("list")
@json_option
def list_studies(as_json: bool) -> None:
    """List the built-in studies.

    \b
    sweep list
    """
    import tomllib

    from sweep.studies.source import built_in_studies

    titles = {
        name: tomllib.loads(path.read_text(encoding="utf-8"))["title"] for name, path in built_in_studies().items()
    }
    if as_json:
        click.echo(json.dumps(titles, indent=1))
        return
    width = max(map(len, titles))
    for name, title in titles.items():
        click.echo(f"{name:{width}}  {title}")


@main.command()
@click.argument("experiment", default="core.experiment:link")
@json_option
def params(experiment: str, as_json: bool) -> None:
    """List the parameters of EXPERIMENT (module:attribute or file.py:attribute) with unit, default, allowed values and
    meaning.

    \b
    sweep params
    sweep params my_experiment.py:experiment
    """
    from sweep.load import load_experiment

    parameters = load_experiment(experiment).parameters
    rows = [
        {"name": p.name, "unit": p.unit, "default": p.default, "allowed": p.allowed(), "meaning": p.meaning}
        for p in parameters
    ]
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    for row in rows:
        default = "see below" if row["default"] is None else row["default"]
        unit = f" [{row['unit']}]" if row["unit"] else ""
        click.echo(f"{row['name']}{unit}  default: {default}\n    {row['meaning']}; {row['allowed']}")
