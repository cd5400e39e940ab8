"""A hundred thousand points in a thousand parts: how long merging them takes, and in what memory."""

import multiprocessing
import tempfile
from functools import partial
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch
from benchmarks.trivial import toml

POINTS_AND_PARTS = {"tiny": (900, 5), "normal": (100_000, 1000), "full": (100_000, 1000)}


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds and memory of the merge and of one part, each measured once: making the parts is long."""
    points, parts = POINTS_AND_PARTS[size]

    def below(most: float) -> Target | None:
        return None if size == "tiny" else Target("<=", most)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "m.toml").write_text(toml(points))
        one = watch([*SWEEP, "run", "m.toml", "--quiet", "-o", "m.zarr", "--part", f"1/{parts}"], folder)
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            pool.map(partial(_run, folder, parts), range(2, parts + 1))
        stores = sorted(path.name for path in folder.glob("m.zarr.part-*"))
        merged = watch([*SWEEP, "merge", *stores, "-o", "m.zarr", "--trust"], folder)
        return [
            Measured(f"{points:,} points, one of {parts:,} parts", [one.seconds], "s"),
            Measured("  peak", [one.peak_bytes / 1e6], "MB"),
            Measured(f"{parts:,} parts merged", [merged.seconds], "s", below(60.0)),
            Measured("  peak, in that of one part", [merged.peak_bytes / one.peak_bytes], "", below(1.5)),
        ]


def _run(folder: Path, parts: int, number: int) -> None:
    import linksweep

    linksweep.run(str(folder / "m.toml"), folder / "m.zarr", part=f"{number}/{parts}", pool="serial")
