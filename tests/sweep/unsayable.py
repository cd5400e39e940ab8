"""An experiment that fails with a message that is too long and that no encoding of Unicode can hold."""

from linksweep.sweep.contract import Experiment, Output, Parameter


def evaluate(points, n_sim, rng, catalogue_rng):
    if points[0]["place"] == 2:
        raise ValueError("\udc80 " + "x" * 10**6 + " the end")
    return {"total": [rng.normal(size=n_sim).sum()]}


experiment = Experiment(
    name="unsayable",
    version=1,
    parameters=(Parameter("place", "int", 0, "where"),),
    sums={"total": ()},
    outputs=(Output("mean", "", "mean", headline=True),),
    evaluate=evaluate,
    summarise=lambda sums, n, n_cat: {"mean": sums["total"] / n},
)
