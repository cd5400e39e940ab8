"""The benchmark of the core still runs and says what it should; its numbers are for people, not for a test."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "core_speed.py"


def test_the_benchmark_runs_once(tmp_path):
    report = tmp_path / "speed.json"
    run = subprocess.run(
        [sys.executable, str(SCRIPT), "--quick", "--json", str(report)], capture_output=True, text=True, check=True
    )
    found = json.loads(report.read_text())
    assert len(found["ratio"]) == 4 * 4 + 2
    assert all(np.isfinite(ratio) and ratio > 0.0 for ratio in found["ratio"].values())
    assert all(name in run.stdout for name in found["ratio"])
