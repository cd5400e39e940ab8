"""Runs benchmarks, prints each number beside its target, and writes them as JSON.

python -m benchmarks                     all, a few minutes on two idle cores
python -m benchmarks overhead start-up   some
python -m benchmarks --repetitions 5     more; every number is a median
python -m benchmarks --json out.json
python -m benchmarks --tiny              only that they run
python -m benchmarks --full              nothing is scaled up from a part of it
"""

import argparse
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

from benchmarks import (
    cluster,
    core_speed,
    functions,
    large,
    main_job,
    memory,
    million,
    overhead,
    parts,
    scale,
    scaling,
    small_catalogues,
    start_up,
    tie,
)
from benchmarks.measured import Measured, host_load

BENCHMARKS = {
    "core-speed": core_speed.measure,
    "overhead": overhead.measure,
    "functions": functions.measure,
    "large": large.measure,
    "main-job": main_job.measure,
    "small-catalogues": small_catalogues.measure,
    "memory": memory.measure,
    "scaling": scaling.measure,
    "start-up": start_up.measure,
    "cluster": cluster.measure,
    "scale": scale.measure,
    "million": million.measure,
    "parts": parts.measure,
    "tie": tie.measure,
}


NOT_OF_USERS = (
    "PYTHONDONTWRITEBYTECODE",  # users have compiled modules; the first start makes them
    "OPENBLAS_CORETYPE",  # and the kernels that OpenBLAS chooses for their processor
    "OPENBLAS_L2_SIZE",
)
"""Variables that are removed from the environment before anything is measured."""


def line(one: Measured) -> str:
    """Return a number as the table shows it."""
    target = "" if one.target is None else f"{one.target.relation} {one.target.value:,g}"
    value = f"{one.value:,.0f}" if one.value >= 100 else f"{one.value:.3g}"
    return f"{one.name:52} {value:>10} {one.unit:10} {target:>12}  {one.verdict:6}  {one.note}".rstrip()


def main() -> int:
    """Measure, print, write; 1 if a target is missed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}; all by default")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--tiny", dest="size", action="store_const", const="tiny", default="normal")
    size.add_argument("--full", dest="size", action="store_const", const="full")
    parser.add_argument("--without-peers", action="store_true", help="install and measure no other packages")
    options = parser.parse_args()
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(BENCHMARKS)}")
    if removed := [f"{name}={os.environ.pop(name)}" for name in NOT_OF_USERS if name in os.environ]:
        print(f"measured without {', '.join(removed)}")
    report: dict[str, Any] = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "size": options.size,
        "without": removed,
        "benchmarks": {},
    }
    missed = False
    for name in options.names or BENCHMARKS:
        before = host_load()
        result = BENCHMARKS[name](options.size, options.repetitions, not options.without_peers)
        load = [before, host_load()]
        print(f"\n{name} (load average per core {load[0]:.1f} before, {load[1]:.1f} after)")
        print("\n".join(map(line, result)), flush=True)
        report["benchmarks"][name] = {"load_per_core": load, "measured": [one.as_json() for one in result]}
        missed |= any(one.verdict == "MISSED" for one in result)
        if options.json:
            options.json.write_text(json.dumps(report, indent=1) + "\n")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
