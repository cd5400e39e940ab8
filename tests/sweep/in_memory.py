"""Results of a study without a store: what `sweep run` computes and derives, in this process."""

import numpy as np
import xarray as xr

from linksweep.sweep.executing.worker import run_block
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.block import ledger_key
from linksweep.sweep.planning.checked_grid import make_grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.streams import generators_of
from linksweep.sweep.running.covariance import covariances
from linksweep.sweep.running.results import assemble
from linksweep.sweep.studies.reader import study_from_dict
from linksweep.sweep.studies.record import provenance


def results_of(document) -> xr.Dataset:
    """Return the dataset that a run of this study leaves."""
    study = study_from_dict(document)
    plan = Plan(make_grid(study))
    together = {}
    for point in plan.grid.points():
        together.setdefault(point.stream, []).append(point)
    defaults, seed = study.experiment.defaults(), study.sampling.seed
    rows, sums = {}, []
    for stream, points in together.items():
        full = [defaults | point.parameters for point in points]
        for block in plan.blocks(max(plan.cost(p.parameters) for p in points)):
            rows |= {ledger_key(p.digest, block): len(sums) + k for k, p in enumerate(points)}
            pairs = generators_of(seed, stream, block)
            sums.extend(run_block(study.experiment, full, block.n_sim, pairs)[0])
    accumulator = Accumulator(plan, rows, np.array(sums))
    dataset = assemble(plan, accumulator)
    if study.sampling.common_random_numbers:
        dataset = dataset.assign(covariances(plan, accumulator, rows, np.array(sums)))
    return dataset.assign_attrs(provenance(study))
