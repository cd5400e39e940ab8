"""The models swept by xyzpy: each function is what a user writes."""

import models
import numpy as np
import xyzpy


def sir(axes):
    """Sweep the epidemic."""
    ours = {"var_dims": {"infected": ["time"]}, "var_coords": {"time": models.DAYS}}
    runner = xyzpy.Runner(models.sir, var_names=["infected", "peak"], **ours)
    harvester = xyzpy.Harvester(runner, data_name="sir.h5", engine="h5netcdf")
    harvester.harvest_combos(axes, parallel=True, verbosity=0)
    return harvester.full_ds


def _seeded(load, seed):
    return models.wait(load, np.random.default_rng(seed))


def wait(axes):
    """Sweep the queue."""
    runner = xyzpy.Runner(_seeded, var_names="wait")
    harvester = xyzpy.Harvester(runner, data_name="wait.h5", engine="h5netcdf")
    seeds = range(models.REALISATIONS)
    harvester.harvest_combos({**axes, "seed": seeds}, parallel=True, verbosity=0)
    result = harvester.full_ds["wait"]
    return result.mean("seed").to_dataset(name="wait_mean").assign(wait_q95=result.quantile(0.95, "seed"))


def sun(axes):
    """Sweep the tilted plane."""
    runner = xyzpy.Runner(models.sun, var_names="sun")
    harvester = xyzpy.Harvester(runner, data_name="sun.h5", engine="h5netcdf")
    harvester.harvest_combos(axes, parallel=True, verbosity=0)
    return harvester.full_ds


def vectorised(axes):
    """Sweep the product; there are no calls for many points."""
    return trivial(axes)


def trivial(axes):
    """Sweep the product, a point a call."""
    runner = xyzpy.Runner(models.area, var_names="area")
    harvester = xyzpy.Harvester(runner, data_name="area.h5", engine="h5netcdf")
    harvester.harvest_combos(axes, verbosity=0)
    return harvester.full_ds


def nap(axes):
    """Sweep what takes half a second, on four workers."""
    runner = xyzpy.Runner(models.nap, var_names="nap")
    harvester = xyzpy.Harvester(runner, data_name="nap.h5", engine="h5netcdf")
    harvester.harvest_combos(axes, parallel=True, num_workers=4, verbosity=0)
    return harvester.full_ds
