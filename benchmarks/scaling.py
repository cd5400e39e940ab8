"""Strong and weak scaling of the quasar study, by `sweep scaling`, in processes and in threads."""

import json
import tempfile
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch

SETTINGS = {
    "tiny": ["--set", "n_cat=2", "--set", "n_sim=10", "--axis", "v_max=14"],
    "normal": ["--set", "n_sim=300"],
    "full": ["--set", "n_cat=1000"],
}


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return the efficiency of two workers, and the seconds to start and end them."""
    report = []
    turns = str(1 if size == "tiny" else repetitions)
    for pool in ("processes", "threads"):
        with tempfile.TemporaryDirectory() as name:
            command = [*SWEEP, "scaling", "quasars", "--workers", "1,2", "--pool", pool, "--repetitions", turns]
            rows = json.loads(watch([*command, *SETTINGS[size], "--json"], Path(name)).output)["rows"]
        target = Target(">=", 0.9) if pool == "processes" and size != "tiny" else None
        for row in rows:
            words = f"{row['kind']} scaling, {row['workers']} {pool}"
            if row["workers"] == 1 and row["kind"] == "strong":
                report.append(Measured(f"1 worker, {pool}", [row["seconds"]], "s"))
            elif row["workers"] > 1:
                report.append(Measured(f"{words}: efficiency", [row["efficiency"]], "", target))
                report.append(Measured("  seconds", [row["seconds"]], "s"))
                report.append(Measured("  to start and end the workers", [row["start_seconds"]], "s"))
    return report
