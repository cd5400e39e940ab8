"""An experiment whose blocks take as long as the study says and compute nothing."""

import time

from sweep.contract import Experiment, Output, Parameter


def sleep(points, n_sim, rng, catalogue_rng):
    """Return after the seconds of the point."""
    time.sleep(points[0]["seconds"])
    return {"total": rng.standard_normal(n_sim).sum()}


experiment = Experiment(
    name="sleeping",
    version=1,
    parameters=(
        Parameter("seconds", "float", 0.0, "how long a block takes", unit="s", minimum=0.0),
        Parameter("number", "int", 1, "which of them"),
    ),
    sums={"total": ()},
    outputs=(Output("mean", "", "mean of what was drawn", headline=True),),
    evaluate=sleep,
    summarise=lambda sums, n, n_cat: {"mean": sums["total"] / n},
)
