"""Results of 50 MB each: what it costs to keep them, beside one write of all of them by xarray."""

import json
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.measured import Measured, Size, Target, watch

SIDE = {"tiny": 800, "normal": 2500, "full": 2500}
POINTS = 8

SCRIPT = """
import json, resource, sys, time
import linksweep, numpy as np, xarray as xr, zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from benchmarks.large import POINTS, image

def cpu():
    both = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)

def plain(side):
    dims = "phase", "y", "x"
    ds = xr.Dataset({"image": (dims, np.stack([image(float(k), side)["image"] for k in range(POINTS)]))})
    encoding = {"compressors": [ZstdCodec(level=1), Crc32cCodec()]}
    ds.to_zarr("plain.zarr", mode="w", consolidated=False, zarr_format=3, encoding={"image": encoding})

def swept(side, **options):
    axes = {"phase": np.arange(float(POINTS))}
    linksweep.run(image, "swept.zarr", axes=axes, fixed={"side": side}, fresh=True, **options)

begun = time.perf_counter(), cpu()
SWEEP
print(json.dumps([time.perf_counter() - begun[0], cpu() - begun[1]]))
"""
PROGRAMS = {
    "plain": "plain({side})",
    "in one process": "swept({side}, pool='serial')",
    "2 workers": "swept({side}, workers=2)",
}


def image(phase: float, side: int = 2500) -> dict[str, np.ndarray]:
    """Return an image of noise, which does not compress."""
    return {"image": np.random.default_rng(int(phase)).normal(size=(side, side))}


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds, CPU seconds and peak memory of each program, beside those of the plain write in the same turn."""
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in PROGRAMS}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repetitions):
            for name, program in PROGRAMS.items():
                script = SCRIPT.replace("SWEEP", program.format(side=SIDE[size]))
                watched = watch([sys.executable, "-c", script], Path(folder))
                seconds, cpu_s = json.loads(watched.output.splitlines()[-1])
                taken[name].append((seconds, cpu_s, watched.peak_bytes / 1e6))
        files = {file.stat().st_ino: file.stat().st_size for file in Path(folder, "swept.zarr").rglob("*.*")}
    bytes_of = POINTS * 8 * SIDE[size] ** 2
    target = None if size == "tiny" else Target("<=", 1.5)
    measured = []
    for number, (what, unit) in enumerate([("seconds", "s"), ("CPU", "s"), ("peak", "MB")]):
        plain = [one[number] for one in taken["plain"]]
        measured.append(Measured(f"8 results of 50 MB, one plain write, {what}", plain, unit))
        for name in list(PROGRAMS)[1:]:
            values = [one[number] for one in taken[name]]
            ratios = [value / other for value, other in zip(values, plain, strict=True)]
            note = f"{statistics.median(values):.3g} {unit}"
            measured.append(Measured(f"  {name}, in that", ratios, "", target, note))
    measured.append(Measured("  stored bytes in those of the arrays", [sum(files.values()) / bytes_of], ""))
    return measured
