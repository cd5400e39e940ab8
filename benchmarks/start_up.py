"""Start-up: `sweep --help` against importing click, a study of one point, and what its imports cost."""

import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch

MOST_SHOWN = 10

ONE_POINT = """
title = "One point"
[fixed]
n_obj = 28
[sampling]
n_sim = 10
n_cat = 1
seed = 1
"""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds, their ratio, and the share of each package in the time of all imports."""
    turns = 1 if size == "tiny" else 3 * repetitions  # they are short
    helping, clicking, running, finished, importing = [], [], [], [], []
    profile: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "one.toml").write_text(ONE_POINT)
        for turn in range(turns):
            clicking.append(watch([sys.executable, "-c", "import click"], folder).seconds)
            helping.append(watch([*SWEEP, "--help"], folder).seconds)
            if turn % 3 == 0:
                running.append(watch([*SWEEP, "run", "one.toml", "-o", f"{turn}.zarr"], folder).seconds)
                finished.append(watch([*SWEEP, "run", "one.toml", "-o", f"{turn}.zarr"], folder).seconds)
                names = (
                    "sweep.running.run",
                    "sweep.running.progress",
                    "sweep.analysis.tables",
                    "core.experiment",
                )
                modules = "import " + ", ".join(f"linksweep.{name}" for name in names)
                importing.append(watch([sys.executable, "-c", modules], folder).seconds)
        command = f"{sys.executable} -X importtime -c '{modules}' 2>&1"
        for text in watch(["/bin/sh", "-c", command], folder).output.splitlines():
            if result := re.match(r"import time:\s+(\d+) \|\s+\d+ \| +(\w+)", text):
                profile[result[2]] += int(result[1])
    ratio = [a / b for a, b in zip(helping, clicking, strict=True)]
    whole = sum(profile.values())
    return [
        Measured("python -c 'import click'", clicking, "s"),
        Measured("sweep --help", helping, "s"),
        Measured("the second over the first", ratio, "", Target("<=", 3.0)),
        Measured("sweep run of one point", running, "s", Target("<=", 0.6) if size != "tiny" else None),
        Measured(
            "sweep run of it again, when it is done", finished, "s", Target("<=", 0.45) if size != "tiny" else None
        ),
        Measured("the imports that it needs", importing, "s"),
        *(
            Measured(f"  imports of {package}", [100.0 * microseconds / whole], "%")
            for package, microseconds in profile.most_common(MOST_SHOWN)
        ),
    ]
