"""An experiment whose blocks take as long as the study says."""

import time

from linksweep.sweep.contract import Experiment, Output, Parameter


def sleep(points, n_sim, rng, catalogue_rng):
    time.sleep(points[0]["seconds"])
    return {"total": rng.standard_normal(n_sim).sum()}


experiment = Experiment(
    name="sleepers",
    version=1,
    parameters=(
        Parameter("seconds", "float", 0.0, "how long a block takes", unit="s", minimum=0.0),
        Parameter("sheep", "int", 1, "which of them"),
    ),
    sums={"total": ()},
    outputs=(Output("mean", "", "mean of what it dreamt of", headline=True),),
    evaluate=sleep,
    summarise=lambda sums, n, n_cat: {"mean": sums["total"] / n},
    cost=lambda point: 2.0**24,
)
