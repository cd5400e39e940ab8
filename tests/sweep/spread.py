"""An experiment whose results have known values, with errors of realisations and of catalogues that go together."""

import numpy as np

from sweep.contract import Experiment, Output, Parameter

SCATTER = 0.3
"""Catalogues differ in the logarithm of their scale by so much, a normal deviate."""
MEAN_SQUARE = np.exp(2.0 * SCATTER**2)
"""Mean of the squared scale."""


def variance(law, x):
    """Return the true mean square of a realisation for a catalogue of scale 1."""
    return x**-1.0 if law == "power" else 1.0 + 4.0 * np.exp(-0.6 * x)


def evaluate(points, n_sim, rng, catalogue_rng):
    """Two normals, mixed by an angle that depends on x: points that are far apart have less in common."""
    scale = np.exp(SCATTER * catalogue_rng.standard_normal())
    z, w = rng.standard_normal((2, n_sim))
    drawn = []
    for p in points:
        angle = 0.3 * p["x"] ** 0.5
        width = scale * np.sqrt(variance(p["law"], p["x"]))
        drawn.append(width * (z * np.cos(angle) + w * np.sin(angle)))
    return {"squares": [np.sum(d**2) for d in drawn]}


def summarise(sums, n, n_cat):
    width = np.sqrt(sums["squares"] / n)
    return {"width": width, "width_mc_error": width / np.sqrt(2.0 * n)}


experiment = Experiment(
    name="spread",
    version=1,
    parameters=(
        Parameter("x", "float", 1.0, "abscissa", above=0.0),
        Parameter("law", "str", "power", "how the width depends on x", choices=("power", "levelling")),
        Parameter("copy", "int", 0, "another draw of everything", minimum=0),
    ),
    sums={"squares": ()},
    outputs=(Output("width", "mas", "RMS", headline=True), Output("width_mc_error", "mas", "its error")),
    evaluate=evaluate,
    summarise=summarise,
    shared=("x",),
)
