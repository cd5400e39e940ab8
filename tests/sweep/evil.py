"""An experiment whose every text tries to get out of the page that shows it; one of its points fails."""

from linksweep.sweep.contract import Experiment, Output, Parameter

BREAK = "</script><script>window.owned = true</script>"
METALS = ("<img src=x onerror='window.owned = true'>", "$$x^$$", "tin")


def toss(points, n_sim, rng, catalogue_rng):
    (point,) = points
    if point["coins"] == 5 and point["metal"] == "tin":
        raise ValueError(f"{BREAK} is what failed")
    return {"heads": [rng.binomial(point["coins"], 0.4, size=n_sim).sum()], "tosses": [n_sim * point["coins"]]}


experiment = Experiment(
    name="evil",
    version=1,
    parameters=(
        Parameter("coins", "int", 10, BREAK, minimum=1),
        Parameter("metal", "str", METALS[0], "what it is made of", choices=METALS),
    ),
    sums={"heads": (), "tosses": ()},
    outputs=(Output("share", "", BREAK, headline=True),),
    evaluate=toss,
    summarise=lambda sums, n, n_cat: {"share": sums["heads"] / sums["tosses"]},
)
