"""Results of a study without a store: what `sweep run` computes and derives, in this process."""

import numpy as np
import xarray as xr

from linksweep.sweep.contract.block import BlockRows, ledger_key
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import Plan, generators_of
from linksweep.sweep.running.results import assemble, covariances
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
    keys, rows = [], []
    for stream, points in together.items():
        full = [defaults | point.parameters for point in points]
        for block in plan.blocks(max(plan.cost(p.parameters) for p in points)):
            keys += [ledger_key(p.digest, block) for p in points]
            outcomes = study.experiment.compute(full, block.n_sim, generators_of(seed, stream, block))
            rows += [outcome.row for outcome in outcomes]
    ledger, index = np.array(rows, dtype=study.experiment.reducer.dtype), BlockRows(keys)
    accumulator = Accumulator(plan, index, ledger)
    dataset = assemble(plan, accumulator)
    if study.sampling.common_random_numbers:
        dataset = dataset.assign(covariances(plan, accumulator, index, ledger))
    return dataset.assign_attrs(provenance(study))
