"""Points whose sums give no results."""

from collections.abc import Sequence

import numpy as np

from linksweep.sweep.contract import check_finite
from linksweep.sweep.planning.accumulator import Accumulator


def failing(accumulator: Accumulator, indices: Sequence[int]) -> dict[int, Exception]:
    """Return those of the points whose results cannot be computed from their sums or are not finite, and why."""
    experiment = accumulator.plan.grid.study.experiment
    n = accumulator.realisations[list(indices)].astype(float)
    n_cat = np.full(len(indices), float(accumulator.plan.grid.study.sampling.n_cat))
    try:
        results = experiment.reducer.finish(accumulator.total[list(indices)], n, n_cat)
        check_finite(results, experiment.nan_outputs())
    except Exception as error:  # whatever a user's function raises
        if len(indices) == 1:
            return {indices[0]: error}
        half = len(indices) // 2
        return failing(accumulator, indices[:half]) | failing(accumulator, indices[half:])
    return {}
