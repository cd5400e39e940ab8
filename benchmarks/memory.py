"""Memory does not grow with the realisations: the largest process of a run at the faintest limit."""

import tempfile
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch

N_SIM = {"tiny": (16, 64), "normal": (10_000, 1_000_000), "full": (10_000, 1_000_000)}
MEGABYTE = 1e6

STUDY = """
title = "GAIA at V = 20"
[fixed]
catalogue = "quasars"
model = "gaia"
v_max = 20.0
[sampling]
n_sim = {n_sim}
n_cat = 1
seed = 1
"""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return the peak resident memory of any process of the tree, for few and for many realisations."""
    few, many = N_SIM[size]
    peaks: dict[int, list[float]] = {few: [], many: []}
    for _ in range(1 if size == "tiny" else repetitions):
        for n_sim, result in peaks.items():
            with tempfile.TemporaryDirectory() as name:
                (Path(name) / "study.toml").write_text(STUDY.format(n_sim=n_sim))
                run = watch([*SWEEP, "run", "study.toml", "--workers", "2"], Path(name))
                result.append(run.peak_bytes / MEGABYTE)
    limit = Target("<=", 400.0) if size != "tiny" else None
    ratios = [b / a for a, b in zip(peaks[few], peaks[many], strict=True)]
    return [
        Measured(f"peak of any process, n_sim = {few:,}", peaks[few], "MB", limit),
        Measured(f"peak of any process, n_sim = {many:,}", peaks[many], "MB", limit),
        Measured("many over few", ratios, "", Target("<=", 1.1) if size != "tiny" else None),
    ]
