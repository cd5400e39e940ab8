"""Writes docs/reference.md from the code: ``python docs/make_reference.py``; a test keeps the two in step."""

from pathlib import Path

from linksweep.core.experiment import link
from linksweep.sweep.contract import Output, Parameter
from linksweep.sweep.studies import built_in_studies
from linksweep.sweep.studies.reader import load_study
from linksweep.sweep.studies.study import Sampling

INTRODUCTION = """# Studies, parameters and results

Made from the code by `python docs/make_reference.py`.

## Built-in studies

`sweep run NAME` runs one; the file behind it is in the folder `sweeps`.
"""


def reference() -> str:
    """Return the whole page."""
    studies = [load_study(name) for name in built_in_studies()]
    rows = [(f"`{s.name}`", s.title, " x ".join(f"{axis} {len(v)}" for axis, v in s.axes.items())) for s in studies]
    return "\n".join(
        [
            INTRODUCTION,
            *table(("study", "what it is", "axes and their lengths"), rows),
            "\n## Sampling\n",
            *table(("key", "default"), [(f"`{n}`", f"{f.default}") for n, f in Sampling.model_fields.items()]),
            "\n## Parameters of the link\n",
            "For `[axes]` and `[fixed]`; `sweep params` prints the same.\n",
            *table(("parameter", "unit", "default", "meaning", "allowed"), map(parameter_row, link.parameters)),
            "\n## Results of the link\n",
            *table(("variable", "unit", "dimensions", "meaning"), map(output_row, link.outputs)),
            "",
        ]
    )


def parameter_row(parameter: Parameter) -> tuple[str, ...]:
    default = "the experiment decides" if parameter.default is None else f"{parameter.default}"
    return f"`{parameter.name}`", parameter.unit, default, parameter.meaning, parameter.allowed()


def output_row(output: Output) -> tuple[str, ...]:
    return f"`{output.name}`", output.unit.replace("|", "\\|"), ", ".join(output.dims), output.meaning


def table(head, rows) -> list[str]:
    return [line(head), line(["---"] * len(head)), *map(line, rows)]


def line(cells) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    Path(__file__).with_name("reference.md").write_text(reference(), encoding="utf-8")
