"""Offers completions to a shell, which asks at each press of a key, so that nothing heavy is imported."""

import tomllib
from contextlib import suppress
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from click import Context, Parameter
from click.shell_completion import CompletionItem

SAMPLING = ("n_sim", "n_cat", "seed", "precision", "max_n_sim", "keep_samples", "common_random_numbers")


def studies(_context: Context, _parameter: Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the built-in studies and the TOML files here; where neither fits, whatever file the shell knows."""
    names = [*_built_in(), *sorted(path.name for path in Path().glob("*.toml"))]
    fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
    return fitting or [CompletionItem(incomplete, type="file")]  # a shell takes one kind or the other


def stores(_context: Context, _parameter: Parameter, incomplete: str) -> list[CompletionItem]:
    """Offer the directories."""
    return [CompletionItem(incomplete, type="dir")]


def axes(context: Context, _parameter: Parameter, incomplete: str, more: tuple[str, ...] = ()) -> list[CompletionItem]:
    """Offer the axes of the study that was given before, and what it fixes."""
    named = context.params.get("study") or next(iter(context.args), "")  # not parsed where an option misses its value
    tables = _document(named)
    found = [*tables.get("axes", {}), *tables.get("fixed", {})]
    return [CompletionItem(f"{key}=") for key in (*found, *more) if f"{key}=".startswith(incomplete)]


settings = partial(axes, more=SAMPLING)
"""Offer the keys that the study given before sets, and those of its sampling."""


def _document(study: object) -> dict[str, Any]:
    """Return what a study's file says; nothing where there is none: a shell has no place for an error."""
    with suppress(OSError, ValueError, RecursionError):
        path = _built_in().get(str(study), Path(str(study)))
        if path.stat().st_size < 100_000:
            document = tomllib.loads(path.read_text(encoding="utf-8"))
            return {key: value for key, value in document.items() if isinstance(value, dict)}
    return {}


def _built_in() -> dict[str, Path]:
    files = sorted((resources.files("linksweep") / "sweeps").iterdir(), key=str)
    return {file.name.removesuffix(".toml"): Path(str(file)) for file in files if file.name.endswith(".toml")}
