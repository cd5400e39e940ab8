"""A small experiment that has nothing to do with astrometry, as a user would write one."""

from linksweep.sweep.contract import Experiment, Output, Parameter


def toss(points, n_sim, rng, catalogue_rng):
    bias = 0.1 * catalogue_rng.uniform(-1, 1)
    heads = [rng.binomial(p["coins"], p["chance"] + bias, size=n_sim).sum() for p in points]
    return {"heads": heads, "tosses": [n_sim * p["coins"] for p in points]}


def summary(sums, n, n_cat):
    return {"share": sums["heads"] / sums["tosses"]}


PARAMETERS = (
    Parameter("coins", "int", 10, "coins in one toss", minimum=1),
    Parameter("chance", "float", 0.5, minimum=0.2, maximum=0.8),
    Parameter("metal", "str", "gold", "what it is made of", choices=("gold", "tin")),
)
OUTPUTS, SUMS = (Output("share", "", "share of heads", headline=True),), {"heads": (), "tosses": ()}
experiment = Experiment("coins", 1, PARAMETERS, SUMS, OUTPUTS, toss, summary, cost_unit="random numbers")
