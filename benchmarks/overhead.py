"""What a point costs the platform: a trivial grid on two worker processes, beside other ways to do it.

The clock runs from when the workers are there to the last durable, labelled result.  The peers are installed into an
environment of their own in the user's cache folder, made once; every process counts, ours and theirs.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.measured import Measured, Size, Target, watch

PACKAGES = (
    "xyzpy",
    "matplotlib",
    "h5netcdf",
    "joblib",
    "pipefunc",
    "signac",
    "distributed",
    "xarray",
    "zarr",
    "cloudpickle",
)
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
from benchmarks.trivial import study
from sweep.studies.reader import study_from_dict
from sweep.executing.choose import Resources
from sweep.running.run import Silent, run_study

class Clock(Silent):
    def start(self, survey, where, workers):
        self.begun, self.cpu = time.perf_counter(), time.process_time()

    def written(self):
        self.seconds, self.cpu = time.perf_counter() - self.begun, time.process_time() - self.cpu

if __name__ == "__main__":
    points, pool = int(sys.argv[1]), sys.argv[2]
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock()
        chosen = Resources(pool="serial") if pool == "serial" else Resources(workers=2, pool=pool)
        dataset, failures = run_study(study_from_dict(study(points)), Path(folder) / "s.zarr", chosen, clock)
        assert not failures and dataset.attrs["points_done"] == dataset.attrs["points"]
        print(dataset.attrs["points"] / clock.seconds, dataset.attrs["points"] / clock.cpu)
"""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return points a second of ours and of the peers, taking turns."""
    turns = 1 if size == "tiny" else repetitions
    python = _environment() if peers else None
    ours: dict[str, list[tuple[float, float]]] = {"processes": [], "serial": []}
    theirs: dict[str, list[float]] = {}
    missing: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "ours.py").write_text(OURS)
        for _ in range(turns):
            for pool, found in ours.items():
                output = watch([sys.executable, "ours.py", str(POINTS[size]), pool], folder).output
                rate, cpu_rate = map(float, output.split())
                found.append((rate, cpu_rate))
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
    ]
    durable = []
    for peer, (_, kept) in PEERS.items() if peers else ():
        note = missing.get(peer, "" if kept else "nothing kept")
        report.append(Measured(peer, theirs.get(peer, []), "points/s", note=note))
        if kept and peer in theirs:
            durable.append(report[-1].value)
    if durable:
        ratio = report[0].value / max(durable)
        report.append(Measured("ours over the fastest durable peer", [ratio], "", Target(">=", 1.0)))
    return report


def _environment() -> Path:
    """Return the Python of the peers' environment, made if there is none."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "linksweep-benchmarks"
    python = cache / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not (cache / "ready").exists():
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-m", "venv", str(cache)], check=True)
        for package in PACKAGES:  # one that cannot be installed leaves the others
            subprocess.run([str(python), "-m", "pip", "install", "-q", package], check=False, stderr=subprocess.DEVNULL)
        (cache / "ready").touch()
        print(f"peers installed into {cache} in {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    return python
