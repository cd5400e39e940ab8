"""What a point costs the platform: a trivial grid on two worker processes, beside other ways to do it.

The clock runs from when the workers are there to the last durable, labelled result; every process counts, ours and
theirs.
"""

import sys
import tempfile
from pathlib import Path

from benchmarks.measured import Measured, Size, Target, watch
from benchmarks.peer_environment import environment

HERE = Path(__file__).parent
POINTS = {"tiny": 100, "normal": 10_000, "full": 10_000}

PEERS = {
    "xyzpy crop, batches of 50": (10_000, True),
    "xyzpy crop, singly": (900, True),
    "joblib with a disk cache": (2_500, True),
    "pipefunc, file store": (900, True),
    "pipefunc, in memory": (10_000, False),
    "signac": (900, True),
    "client.map, a task a point": (2_500, False),
    "Zarr region write a point": (100, True),
}
"""By name: the points that are enough for a rate, and whether it leaves durable results."""

OURS = """
import sys, tempfile, time
from pathlib import Path
from benchmarks.trivial import FUNCTION, study
from linksweep.sweep.studies.reader import live_study
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.progress import Progress
from linksweep.sweep.running.run import run_study

class Clock(Progress):
    def start(self, survey, where, workers):
        self.begun, self.cpu = time.perf_counter(), time.process_time()

    def written(self):
        self.seconds, self.cpu = time.perf_counter() - self.begun, time.process_time() - self.cpu

if __name__ == "__main__":
    points, pool = int(sys.argv[1]), sys.argv[2]
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock()
        chosen = Resources(workers=2, pool=pool) if pool == "processes" else Resources(pool="serial")
        document = study(points) | ({"experiment": FUNCTION, "sampling": {}} if pool == "function" else {})
        dataset, failures = run_study(live_study(document), Path(folder) / "s.zarr", chosen, clock)
        assert not failures and dataset.attrs["points_done"] == dataset.attrs["points"]
        print(dataset.attrs["points"] / clock.seconds, dataset.attrs["points"] / clock.cpu)
"""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return points a second of ours and of the peers, taking turns."""
    turns = 1 if size == "tiny" else repetitions
    python = environment() if peers else None
    ours: dict[str, list[tuple[float, float]]] = {"processes": [], "serial": [], "function": []}
    theirs: dict[str, list[float]] = {}
    missing: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "ours.py").write_text(OURS)
        for _ in range(turns):
            for pool, result in ours.items():
                output = watch([sys.executable, "ours.py", str(POINTS[size]), pool], folder).output
                rate, cpu_rate = map(float, output.split())
                result.append((rate, cpu_rate))
            for peer, (points, _) in PEERS.items() if python else ():
                if peer in missing:
                    continue
                wanted = str(100 if size == "tiny" else points)
                try:
                    command = [str(python), str(HERE / "peers.py"), peer, wanted]
                    rate = float(watch(command, folder).output.split()[-1])
                except (RuntimeError, ValueError, IndexError) as error:
                    missing[peer] = str(error).strip().splitlines()[-1]
                    continue
                theirs.setdefault(peer, []).append(rate)
    report = [
        Measured("linksweep, 2 processes", [r for r, _ in ours["processes"]], "points/s", Target(">=", 10_000)),
        Measured("linksweep, client's CPU time alone", [c for _, c in ours["processes"]], "points/s"),
        Measured(
            "linksweep, all in one process, CPU time",
            [c for _, c in ours["serial"]],
            "points/s",
            note="client and worker together; independent of other load",
        ),
        Measured("linksweep, a plain function in one process", [r for r, _ in ours["function"]], "points/s"),
    ]
    durable = []
    for peer, (_, kept) in PEERS.items() if peers else ():
        note = missing.get(peer, "" if kept else "nothing kept")
        report.append(Measured(peer, theirs.get(peer, []), "points/s", note=note))
        if kept and peer in theirs:
            durable.append(report[-1].value)
    if durable:
        for place, words in ((0, "ours"), (3, "a plain function by ours")):
            ratio = report[place].value / max(durable)
            report.append(Measured(f"{words} over the fastest durable peer", [ratio], "", Target(">=", 1.0)))
    return report
