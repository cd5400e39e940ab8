"""Seconds and memory of `sweep plan` for a grid of a million points.

python benchmarks/planning.py [points along each of four axes, 32 by default]

Each study is planned in a process of its own, so that its peak of memory is its own; the time is CPU time.
"""

import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

COINS = str(Path(__file__).parent.parent / "tests" / "sweep" / "coins.py") + ":experiment"

EVERYTHING = "link: model x v_max x error_scale x mission_length"
STUDIES = (
    "coins: coins x chance",
    EVERYTHING,
    "link: the same, quasars",
    "link: n_obj x error_scale x model x mean_pm",
)


def document(name: str, n: int) -> dict[str, object]:
    """Return the study of a name, with about n^4 points."""
    models = ["amex", "gaia", "gaia-2001", "mine"]
    ours = {"nominal_length": 3.0, "sigma_pm": [[9.0, 0.1], [21.0, 2.0]], "position_ratio": 0.7}
    both = {"title": name, "define": {"model": {"mine": ours}}}
    rest = round((n**4 / len(models)) ** (1 / 3))
    scales = {"start": 0.5, "stop": 2.0, "num": rest}
    lengths = {"start": 2.0, "stop": 8.0, "num": rest}
    if name.startswith("coins"):
        axes = {"coins": list(range(1, n * n + 1)), "chance": {"start": 0.2, "stop": 0.8, "num": n * n}}
        return {"title": name, "experiment": COINS, "axes": axes}
    if "mean_pm" in name:
        objects = {"n_obj": {"start": 10, "stop": 9 + rest, "step": 1}, "error_scale": scales, "model": models}
        return both | {"axes": objects | {"mean_pm": {"start": 0.0, "stop": 500.0, "num": rest}}}
    limits = {"start": 14.0, "stop": 20.0, "num": rest}
    fixed = {"catalogue": "quasars"} if "quasars" in name else {"n_obj": 100}
    axes = {"model": models, "v_max": limits, "error_scale": scales, "mission_length": lengths}
    return both | {"axes": axes, "fixed": fixed}


def plan(name: str, n: int) -> None:
    """Plan one study as `sweep plan` does, and print what it took."""
    from linksweep.sweep.code import load_experiment
    from linksweep.sweep.running.run import plan_study
    from linksweep.sweep.studies.reader import live_study

    load_experiment("linksweep.core.experiment:link")  # what is imported is not planned
    begun = time.process_time()
    with TemporaryDirectory() as folder:
        result, _ = plan_study(live_study(document(name, n)), Path(folder) / "none.zarr")
    seconds = time.process_time() - begun
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    points = len(result.grid)
    print(f"{seconds:6.1f} s  {1e6 * seconds / points:5.1f} us a point  {peak_mb:6.0f} MB  {points:9,} points  {name}")


def main() -> None:
    """Plan every study, or the one of a name."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 32
    if len(sys.argv) > 2:
        plan(sys.argv[2], n)
        return
    for name in STUDIES:
        subprocess.run([sys.executable, __file__, str(n), name], check=True)


if __name__ == "__main__":
    main()
