"""The models swept by pipefunc: each function is what a user writes."""

from concurrent.futures import ProcessPoolExecutor

import models
import numpy as np
import xarray as xr
from pipefunc import PipeFunc, Pipeline


def sir(axes):
    """Sweep the epidemic; the curves are objects in an array, without a dimension of their own."""
    mapped = "beta[beta], gamma[gamma] -> infected[beta, gamma], peak[beta, gamma]"
    pipeline = Pipeline([PipeFunc(models.sir, ("infected", "peak"), mapspec=mapped)])
    return pipeline.map(axes, run_folder="sir", show_progress=False).to_xarray()


def _seeded(load, seed):
    return models.wait(load, np.random.default_rng(seed))


def wait(axes):
    """Sweep the queue."""
    pipeline = Pipeline([PipeFunc(_seeded, "wait", mapspec="load[load], seed[seed] -> wait[load, seed]")])
    options = {**axes, "seed": range(models.REALISATIONS)}
    result = pipeline.map(options, run_folder="wait", show_progress=False).to_xarray()["wait"].astype(float)
    return result.mean("seed").to_dataset(name="wait_mean").assign(wait_q95=result.quantile(0.95, "seed"))


def sun(axes):
    """Sweep the tilted plane."""
    mapped = "tilt[tilt], azimuth[azimuth], sky[sky] -> sun[tilt, azimuth, sky]"
    pipeline = Pipeline([PipeFunc(models.sun, "sun", mapspec=mapped)])
    return pipeline.map(axes, run_folder="sun", show_progress=False).to_xarray()


def vectorised(axes):
    """Sweep the product, all points in one call; the result has no labels of its own."""
    width, height = np.meshgrid(*axes.values(), indexing="ij")
    pipeline = Pipeline([PipeFunc(models.area, "area")])
    result = pipeline.map({"width": width, "height": height}, run_folder="vectorised", show_progress=False)
    return xr.Dataset({"area": (tuple(axes), result["area"].output)}, axes)


def trivial(axes):
    """Sweep the product, a point a call."""
    pipeline = Pipeline([PipeFunc(models.area, "area", mapspec="width[width], height[height] -> area[width, height]")])
    return pipeline.map(axes, run_folder="trivial", show_progress=False).to_xarray()


def nap(axes):
    """Sweep what takes half a second, on four workers."""
    pipeline = Pipeline([PipeFunc(models.nap, "nap", mapspec="number[number] -> nap[number]")])
    with ProcessPoolExecutor(4) as pool:
        return pipeline.map(axes, run_folder="nap", executor=pool, show_progress=False).to_xarray()
