"""Results as a run leaves them, of numbers that a test chooses, and what is said of results."""

import json

import numpy as np
import xarray as xr
from click.testing import CliRunner

from linksweep.sweep.analysis.answer import answers
from linksweep.sweep.analysis.compare import compare
from linksweep.sweep.cli import main
from linksweep.sweep.contract import Status
from linksweep.sweep.report.page import report_of, report_page
from linksweep.sweep.result import Result
from linksweep.sweep.studies.reader import live_study
from linksweep.sweep.studies.study import printed_rounding

__all__ = ["answers", "compare", "live_study", "report_of", "report_page"]
N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])
MISSING, DONE, FAILED, EXCLUDED, RUNNING = Status.MISSING, Status.DONE, Status.FAILED, Status.EXCLUDED, Status.RUNNING


def grid(value, error=None, x=N, name="n", unit="", status=None, published=None, claims=(), printed=None, **more):
    """A dataset as a run leaves it, ``width`` in mas over model x one axis; ``published`` is {(model, n): text}."""
    axes, value = ("model", name), np.atleast_2d(np.asarray(value, dtype=float))
    models = max(2, len(value))
    value = np.broadcast_to(value, (models, len(x)))
    variables = {"width": (axes, value, {"units": "mas", "headline": 1})}
    variables["status"] = axes, np.full(value.shape, DONE, np.int8) if status is None else status
    if error is not None:
        variables["width_mc_error"] = (axes, np.broadcast_to(error, value.shape).astype(float), {"units": "mas"})
    if published is not None:
        numbers, roundings = np.full(value.shape, np.nan), np.full(value.shape, np.nan)
        for place, text in published.items():
            numbers[place], roundings[place] = float(text), printed_rounding(text)
        variables["width_published"] = axes, numbers, {"units": "mas", "source": "A paper", **(printed or {})}
        variables["width_published_rounding"] = axes, roundings, {"units": "mas"}
    labels = np.array(["old", "new", *map(str, range(2, models))], dtype=object)
    about = {"title": "Widths", "study_name": "made-up", "claims": json.dumps(list(claims))}
    coords = {"model": labels, name: (name, x, {"units": unit})}
    coords |= {f"{name}_other": x} if any("covariance" in key for key in more) else {}
    return xr.Dataset(variables, coords, about).assign(more)


def text_of(dataset):
    return Result(dataset).written("text")


def shown(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments))).stdout
