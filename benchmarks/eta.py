"""How right the estimated time left is: real runs of studies whose points differ much in cost.

python benchmarks/eta.py [realisations a catalogue]
"""

import sys
import tempfile
import time
from pathlib import Path

from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.progress import Eta, Progress
from linksweep.sweep.running.run import run_study
from linksweep.sweep.studies.reader import live_study

STUDIES = {
    "quasars brighter and fainter, cheap to dear": {
        "axes": {"model": ["gaia", "amex"], "v_max": {"start": 14.0, "stop": 20.0, "step": 0.5}},
        "fixed": {"catalogue": "quasars"},
    },
    "the same, dear to cheap": {
        "axes": {"model": ["gaia", "amex"], "v_max": [20.0 - 0.5 * i for i in range(13)]},
        "fixed": {"catalogue": "quasars"},
    },
    "noisy reference: the design is rebuilt": {
        "axes": {"n_obj": {"start": 20, "stop": 2000, "num": 8, "spacing": "log"}},
        "fixed": {"satellite_errors": "normal", "reference_errors": "normal"},
    },
}


class Recorded(Progress):
    """Keeps what was estimated after each result."""

    def start(self, survey, where, workers):
        self.total = survey.pending.cost
        self.eta = Eta(workers)
        self.begun, self.done, self.rows = time.monotonic(), 0.0, []

    def advance(self, works, result, taken):
        now = time.monotonic()
        self.eta.take(now, taken.done.cost, float(result.seconds.sum()))
        self.done += taken.done.cost
        self.rows.append((self.done / self.total, self.eta.left(now, self.total - self.done), now))


def main(n_sim: int) -> None:
    """Print estimated against true seconds left at some shares of the work."""
    for name, document in STUDIES.items():
        study = live_study({"title": name, **document, "sampling": {"n_sim": n_sim, "n_cat": 20, "seed": 1}})
        for resources in (Resources(pool="serial"), Resources(workers=2, pool="processes")):
            with tempfile.TemporaryDirectory() as folder:
                watched = Recorded()
                run_study(study, Path(folder) / "s.zarr", resources, watched)
            end = watched.rows[-1][2]
            print(f"{name}; {resources.pool}; {end - watched.begun:.1f} s")
            for share in (0.05, 0.2, 0.4, 0.6, 0.8):
                _, left, now = next(row for row in watched.rows if row[0] >= share)
                print(f"  after {share:4.0%}: {left:6.1f} s estimated, {end - now:6.1f} s true, "
                      f"ratio {left / max(end - now, 1e-9):.2f}")  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
