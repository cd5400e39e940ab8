"""The benchmark of the galaxy search still runs, at a hundredth of its size, and finds what is there."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "crossmatch.py"


@pytest.mark.slow
def test_the_benchmark_at_a_small_scale():
    run = subprocess.run(
        [sys.executable, str(SCRIPT), "--scale", "0.01", "--json"], capture_output=True, text=True, check=True
    )
    report = json.loads(run.stdout)
    assert report["stars"] == {"stars": 25_000, "supplement": 176}
    assert report["completeness_without_blunders"] > 0.9  # 27 of about 28 counterparts; the full size gives 0.998
    assert report["counterparts_found_twice"] == 0
    assert report["classes"]["all"]["false"] <= 3  # 0.02 chance pairs are expected
