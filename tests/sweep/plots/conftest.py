"""Pictures are drawn here as where each takes long: matplotlib warns of that, unless it was told where a legend is."""

from itertools import count
from types import SimpleNamespace

import pytest


@pytest.fixture(autouse=True)
def _slow(monkeypatch):
    monkeypatch.setattr("matplotlib.legend.time", SimpleNamespace(perf_counter=count(step=60).__next__))
