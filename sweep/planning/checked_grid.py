"""The grid of a study, after its experiment was asked about every point."""

from collections import Counter
from collections.abc import Mapping
from functools import partial
from typing import Any

from sweep.contract import SweepError
from sweep.planning.grid import Grid
from sweep.planning.point_cache import PointCache
from sweep.planning.point_warnings import PointWarnings
from sweep.planning.unused import UnusedSettings
from sweep.studies.designs import remarks
from sweep.studies.study import POINT, Study

MAX_POINTS = 10_000_000
MAX_PROBLEMS = 20


def make_grid(study: Study) -> Grid:
    """Return the grid of a study after asking the experiment about every point.

    Raises SweepError that lists the points that cannot be computed (grouped by reason; it looks no further after
    `MAX_PROBLEMS` reasons), points that are the same point twice, or a grid too large or empty.
    """
    grid = Grid(study)
    if len(grid) > MAX_POINTS:
        sizes = " x ".join(f"{name} {length:,}" for name, length in zip(grid.dimensions, grid.shape, strict=True))
        message = (
            f"the grid has {len(grid):,} points ({sizes}); at most {MAX_POINTS:,} are allowed: cut it into studies "
            "with a store each, or take a design of points (--design)"
        )
        raise SweepError(message, study.source)
    sentences = _repeated(grid)
    reasons: dict[str, int] = {}
    empty = True
    check = PointCache(partial(_reason, study), study.axes)
    settings, warnings = UnusedSettings(study), PointWarnings(study)
    for _, parameters in grid.parameters():
        empty = False
        if (reason := check(parameters)) is None and (reason := settings.reason(parameters)) is None:
            warnings.look(parameters)
            if check.is_constant and settings.is_constant and warnings.is_silent:
                break  # the experiment has the same to say of all points: nothing
            continue
        if reason not in reasons and len(reasons) == MAX_PROBLEMS:
            reasons["... and other reasons; the rest of the grid was not checked"] = 0
            break
        reasons[reason] = reasons.get(reason, 0) + 1
    if empty:
        raise SweepError("every point of the grid is excluded", study.source)
    sentences += [f"{reason} ({n} point{'s' if n > 1 else ''})" if n else reason for reason, n in reasons.items()]
    if not reasons:
        sentences += settings.nowhere()
    if sentences:
        raise SweepError(sentences, study.source)
    grid.warnings.extend([*remarks({} if study.points is None else study.points.origin), *warnings.sentences()])
    return grid


def _repeated(grid: Grid) -> list[str]:
    """Say which points occur twice: as every axis has distinct values, only axes that are zipped can make some."""
    sentences: list[str] = []
    for dimension, axes in grid.dimensions.items():
        if dimension == POINT:
            continue  # a table may repeat a point
        counts = Counter(zip(*(grid.study.axes[name] for name in axes), strict=True))
        repeated = [values for values, n in counts.items() if n > 1]
        for values in repeated[:MAX_PROBLEMS]:
            place = ",".join(f"{name}={value}" for name, value in zip(axes, values, strict=True))
            sentences.append(f"the same point occurs {counts[values]} times: {place}")
        if len(repeated) > MAX_PROBLEMS:
            sentences.append(f"... and {len(repeated) - MAX_PROBLEMS} more points")
    return sentences


def _reason(study: Study, parameters: Mapping[str, Any]) -> str | None:
    try:
        return study.experiment.check(parameters)
    except Exception as error:  # whatever a user's check raises
        return f"the experiment's check of a point raises {type(error).__name__}: {error}"
