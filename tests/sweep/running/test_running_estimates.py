"""Points that are begun have values so far, with present errors that cover; final results and conclusions wait."""

import json
from dataclasses import replace

import numpy as np
import pytest

import linksweep
from linksweep.sweep.planning.point_status import Status


class StopAt:
    """A progress that ends a run, as Ctrl-C does, once this share of its work is done."""

    def __init__(self, share):
        self.share, self.done = share, 0.0

    def start(self, survey, where, workers):
        self.cost = survey.pending.cost

    def advance(self, works, result, taken):
        self.done += taken.done.cost
        if self.done >= self.share * self.cost:
            raise KeyboardInterrupt

    def written(self):
        pass

    def say(self, text):
        pass


def stopped(study, store, share, **options):
    """What a run of a study leaves that was stopped at this share: the dataset with values so far."""
    with pytest.raises(KeyboardInterrupt):
        linksweep.run(study, store, progress=StopAt(share), pool="serial", **options)
    return linksweep.open(store, running=True)


def quasars():
    """The built-in study, to V = 15 only: seconds."""
    whole = linksweep.load_study("quasars")
    return replace(whole, axes={**whole.axes, "v_max": (14.0, 14.5, 15.0)})


def test_quasars_at_a_tenth(tmp_path, sweep_here):
    built_in, store = quasars(), tmp_path / "q.zarr"
    ds = stopped(built_in, store, 0.1)
    assert ds.attrs["running"] == 6
    assert (ds.status == Status.RUNNING).all()
    assert ((ds.n_sim_done >= 500) & (ds.n_sim_done < 5000)).all()
    relative = ds.sigma_spin_mc_error / ds.sigma_spin
    np.testing.assert_allclose(relative, np.sqrt(1.0 / (6.0 * ds.n_sim_done)), rtol=1e-12)
    assert (ds.sigma_spin_catalogue_error > 0.0).all()
    # who opens the store has no values of points that are not done
    plain = linksweep.open(store)
    assert plain.sigma_spin.isnull().all()
    assert (plain.status == Status.MISSING).all()
    assert not [name for name in plain.variables if "(" in name]
    code, shown, _ = sweep_here("show", store)
    assert code == 0
    assert shown.count("running") == 7
    assert f"values so far are of {int(ds.n_sim_done.max()):,} of 10,000 realisations" in shown.replace("\n", " ")
    assert {row["status"] for row in json.loads(sweep_here("show", store, "--json")[1])["rows"]} == {"running"}
    # verdicts and conclusions wait
    code, compared, _ = sweep_here("compare", store, "--json")
    assert code == 1
    assert {one["verdict"] for one in json.loads(compared)["comparisons"]} == {"incomplete"}
    assert "yet" in " ".join(linksweep.answer(ds).sentences)
    # the same command goes on; whole results have nothing of it
    whole = linksweep.run(built_in, store, pool="serial")
    assert whole.identical(linksweep.run(built_in, tmp_path / "again.zarr", pool="serial").assign_attrs(whole.attrs))
    assert linksweep.open(store, running=True).identical(linksweep.open(store))
    assert not [path.name for path in store.iterdir() if "(" in path.name]
