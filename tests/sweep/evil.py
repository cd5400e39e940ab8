"""An experiment whose every text tries to get out of the page that shows it; one of its points fails."""

from linksweep.sweep.contract import Experiment, Output, Parameter

BREAK = "</script><script>window.owned = true</script>"
METALS = ("<img src=x onerror='window.owned = true'>", "$$x^$$", "tin")


def toss(points, n_sim, rng, catalogue_rng):
    (point,) = points
    if point["coins"] == 5 and point["metal"] == "tin":
        raise ValueError(f"{BREAK} is what failed")
    return {"heads": [rng.binomial(point["coins"], 0.4, size=n_sim).sum()], "tosses": [n_sim * point["coins"]]}


def summarise(sums, n, n_cat):
    return {"share": sums["heads"] / sums["tosses"]}


METAL = Parameter("metal", "str", METALS[0], "what it is made of", choices=METALS)
PARAMETERS = Parameter("coins", "int", 10, BREAK, minimum=1), METAL
OUTPUTS, SUMS = (Output("share", "", BREAK, headline=True),), {"heads": (), "tosses": ()}
experiment = Experiment("evil", 1, PARAMETERS, SUMS, OUTPUTS, toss, summarise)
