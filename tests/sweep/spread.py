"""An experiment whose results have known values, with errors of realisations and of catalogues that go together."""

import numpy as np

from linksweep.sweep.contract import Experiment, Output, Parameter

SCATTER = 0.3  # catalogues differ in the logarithm of their scale by so much, a normal deviate
MEAN_SQUARE = np.exp(2.0 * SCATTER**2)  # mean of the squared scale


def variance(law, x):
    return x**-1.0 if law == "power" else 1.0 + 4.0 * np.exp(-0.6 * x)


def evaluate(points, n_sim, rng, catalogue_rng):
    """Five normals, of which each x has its own mixture: points that are far apart have less in common."""
    scale = np.exp(SCATTER * catalogue_rng.standard_normal())
    normals = rng.standard_normal((5, n_sim))
    squares = []
    for p in points:
        weights = np.exp(-0.5 * (2.0 * np.log(p["x"]) - np.arange(5)) ** 2)
        squares.append(variance(p["law"], p["x"]) * scale**2 * np.sum((weights @ normals) ** 2) / (weights @ weights))
    return {"squares": squares}


def summarise(sums, n, n_cat):
    width = np.sqrt(sums["squares"] / n)
    return {"width": width, "width_mc_error": width / np.sqrt(2.0 * n)}


PARAMETERS = (
    Parameter("x", "float", 1.0, "abscissa", above=0.0),
    Parameter("law", "str", "power", "how the width depends on x", choices=("power", "levelling")),
    Parameter("copy", "int", 0, "another draw of everything", minimum=0),
)
OUTPUTS = Output("width", "mas", "RMS", headline=True), Output("width_mc_error", "mas", "its error")
experiment = Experiment("spread", 1, PARAMETERS, {"squares": ()}, OUTPUTS, evaluate, summarise, shared=("x",))
