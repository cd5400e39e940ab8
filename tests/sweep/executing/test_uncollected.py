"""Garbage is collected again after a block that collects none, whatever happens in it."""

import gc

import pytest

from linksweep.sweep.executing.pools import NO_LIMITS, POOLS, uncollected
from linksweep.sweep.studies.reader import load_study


@pytest.fixture(autouse=True)
def collecting():
    assert gc.isenabled()
    yield
    gc.enable()


def test_garbage_is_collected_after_the_block_and_after_an_exception():
    with uncollected():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ImportError), uncollected():
        raise ImportError
    assert gc.isenabled()


def test_a_user_who_collects_none_is_not_overruled():
    gc.disable()
    with uncollected():
        pass
    assert not gc.isenabled()


def test_garbage_is_collected_while_workers_compute_and_where_none_can_start(link_study, monkeypatch):
    study = load_study(str(link_study))
    with POOLS["processes"].open(study.experiment_reference, 1, print, NO_LIMITS, False) as (place, _):
        assert (place.workers, gc.isenabled()) == (1, True)
    monkeypatch.setattr("linksweep.sweep.executing.clusters.local_cluster", None)
    with pytest.raises(TypeError), POOLS["processes"].open(study.experiment_reference, 1, print, NO_LIMITS, False):
        pass
    assert gc.isenabled()
