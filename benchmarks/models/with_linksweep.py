"""The models swept by linksweep: each function is what a user writes."""

import models

import linksweep


def sir(axes):
    """Sweep the epidemic."""
    outputs = [linksweep.Output("infected", dims="time", coords={"time": models.DAYS}), linksweep.Output("peak")]
    swept = linksweep.experiment(outputs=outputs)(models.sir)
    return linksweep.run(swept, axes=axes, store="sir.zarr")


def wait(axes):
    """Sweep the queue."""
    swept = linksweep.experiment(outputs=[linksweep.Output("wait", statistics=["mean", "q95"])])(models.wait)
    sampling = {"n_sim": models.REALISATIONS, "seed": 1}
    return linksweep.run(swept, axes=axes, sampling=sampling, store="wait.zarr")


def sun(axes):
    """Sweep the tilted plane."""
    return linksweep.run(models.sun, axes=axes, store="sun.zarr")


def vectorised(axes):
    """Sweep the product, many points a call."""
    swept = linksweep.experiment(vectorised=True)(models.area)
    return linksweep.run(swept, axes=axes, store="vectorised.zarr")


def trivial(axes):
    """Sweep the product, a point a call."""
    return linksweep.run(models.area, axes=axes, store="trivial.zarr")


def nap(axes):
    """Sweep what takes half a second, on four workers."""
    return linksweep.run(models.nap, axes=axes, workers=4, store="nap.zarr")
