"""A million points: killed half-way and resumed, looked at, run again, and with one more value on an axis."""

import json
import subprocess
import tempfile
import time
from datetime import datetime
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, environment, watch
from benchmarks.trivial import toml

POINTS = {"tiny": 900, "normal": 1_000_000, "full": 1_000_000}

LOOKED_AT = {"status": 2.0, "show": 10.0, "plot": 10.0, "report": 10.0}
"""Commands, and the seconds that each may take."""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds, memory and files, each measured once: it is long."""
    points = POINTS[size]

    def below(most: float) -> Target | None:
        return None if size == "tiny" else Target("<=", most)

    with tempfile.TemporaryDirectory() as name:
        folder, store = Path(name), Path(name) / "m.zarr"
        (folder / "m.toml").write_text(toml(points))
        side = round(points**0.5)
        longer = f"y=0:{side}:1"
        command = [*SWEEP, "run", "m.toml", "--workers", "2", "--quiet", "-o", "m.zarr"]
        killed_s = _killed(command, folder, store, points)
        begun = datetime.now()
        resumed = watch([*command, "--log", "m.log"], folder)
        files = sum(path.is_file() for path in store.rglob("*"))
        report = [
            Measured(f"{points:,} points, killed and resumed: both", [killed_s + resumed.seconds], "s", below(120.0)),
            Measured(
                "  until work begins again",
                [(_work_begins(folder / "m.log") - begun).total_seconds()],
                "s",
                below(10.0),
            ),
            Measured("  client and scheduler, peak", [max(m for _, m in resumed.own_bytes) / 1e6], "MB", below(600.0)),
            Measured("  files in the store", [files], "", below(200.0)),
        ]
        for what, most in LOOKED_AT.items():
            output = {"plot": ["-o", "m.png"], "report": ["-o", "m.html"]}.get(what, [])
            seen = watch([*SWEEP, what, "m.zarr", *output], folder)
            report.append(Measured(f"sweep {what}", [seen.seconds], "s", below(most)))
        again = watch(command, folder)
        report.append(Measured("sweep run, when all is done", [again.seconds], "s"))
        added = watch([*command, "--axis", longer], folder)
        report.append(Measured(f"sweep run with one more value: {side:,} points", [added.seconds], "s", below(15.0)))
        return report


def _rows(store: Path) -> int:
    """Return how many rows the ledger has now."""
    try:
        manifest = json.loads((store / "blocks/zarr.json").read_text())["attributes"]["manifest"]
    except FileNotFoundError:
        return 0
    return sum(part["records"] for part in manifest["parts"])


def _killed(command: list[str], folder: Path, store: Path, points: int) -> float:
    """Begin a run and kill it when half of the points are in the ledger; return its seconds."""
    begun = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, env=environment())
    while process.poll() is None and _rows(store) < points // 2:
        time.sleep(0.05)
    process.kill()
    process.wait()
    return time.perf_counter() - begun


def _work_begins(log: Path) -> datetime:
    """Return when a run said what there is to do, with its workers there."""
    line = next(line for line in log.read_text().splitlines() if " to do " in line or " already" in line)
    return datetime.strptime(line[:23], "%Y-%m-%d %H:%M:%S,%f")
