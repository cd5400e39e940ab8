"""An experiment in which a few points in many do to their process what a user's code may do."""

import ctypes
import os
import re
import time

import numpy as np

from linksweep.sweep.contract import Experiment, Output, Parameter


def crash():
    ctypes.string_at(0)


def leave():
    os._exit(3)


def eat():
    kept = [np.ones(2**27)]  # 1 GiB, faster than the time limit comes on a busy machine
    time.sleep(3600)
    return kept


def hang():
    while True:
        pass


def sleep():
    time.sleep(3600)  # sees no exception


def hold():
    re.match(r"(a+)+$", "a" * 64 + "b")  # years, and no other thread of Python runs


def fail():
    raise ValueError("no such coin")


FATES = {3: crash, 5: leave, 7: eat, 11: hang, 13: sleep, 15: hold, 17: fail}


def evaluate(points, n_sim, rng, catalogue_rng):
    for point in points:
        FATES.get(point["place"], int)()
    return {"total": [rng.normal(p["place"], size=n_sim).sum() for p in points]}


def summarise(sums, n, n_cat):
    return {"mean": sums["total"] / n}


experiment = Experiment(
    name="deadly",
    version=1,
    parameters=(Parameter("place", "int", 0, "which fate"),),
    sums={"total": ()},
    outputs=(Output("mean", "", "mean", headline=True),),
    evaluate=evaluate,
    summarise=summarise,
)
