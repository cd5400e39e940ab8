"""The same trivial grid by other means, in an environment that has them: ``python peers.py NAME POINTS``.

Prints points a second, the pools having been started before wherever one can.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

WORKERS = 2
NAMES = ("a", "b", "c", "d", "e", "f")


def six(x, y):
    """Return what the experiment does, as a tuple."""
    return tuple((k + 1.0) * x + y for k in range(6))


def six_of_pair(pair):
    """Return the same of one argument."""
    return six(*pair)


def warm(pool):
    """Start the processes of a pool."""
    list(pool.map(abs, range(8 * WORKERS)))


def crop(batch: int, axis: list[float]) -> Callable[[], None]:
    """xyzpy: batches as files, sown, grown in a pool, reaped into a labelled netCDF file."""
    import xyzpy
    from joblib.externals.loky import get_reusable_executor

    runner = xyzpy.Runner(six, var_names=list(NAMES))
    get_reusable_executor(max_workers=WORKERS).submit(abs, 1).result()
    harvester = xyzpy.Harvester(runner, data_name="all.h5", engine="h5netcdf")
    made = harvester.Crop(name="crop", batchsize=batch)

    def work() -> None:
        made.sow_combos({"x": axis, "y": axis}, verbosity=0)
        made.grow(num_workers=WORKERS, verbosity=0)
        made.reap()

    return work


def joblib_cache(axis: list[float]) -> Callable[[], None]:
    """joblib: a result a file, by the digest of its arguments; not labelled."""
    import joblib

    cached = joblib.Memory("cache", verbose=0).cache(six)
    parallel = joblib.Parallel(n_jobs=WORKERS)
    parallel(joblib.delayed(abs)(k) for k in range(8 * WORKERS))
    return lambda: parallel(joblib.delayed(cached)(x, y) for x in axis for y in axis)


def pipe(storage: str, axis: list[float]) -> Callable[[], None]:
    """pipefunc: a map over both axes, a file a point or nothing kept."""
    from pipefunc import PipeFunc, Pipeline

    pipeline = Pipeline([PipeFunc(six, "out", mapspec="x[i], y[j] -> out[i, j]")])
    pool = ProcessPoolExecutor(WORKERS)
    warm(pool)
    folder = "run" if storage == "file_array" else None
    return lambda: pipeline.map(
        {"x": axis, "y": axis}, run_folder=folder, storage=storage, executor=pool, show_progress=False
    )


def signac_one(arguments):
    """Do one job of signac: its folder, state point and results."""
    import signac

    x, y = arguments
    job = signac.get_project().open_job({"x": x, "y": y}).init()
    job.doc.update(zip(NAMES, six(x, y), strict=True))


def signac_project(axis: list[float]) -> Callable[[], None]:
    """signac: a folder a point."""
    import signac

    signac.init_project()
    pool = ProcessPoolExecutor(WORKERS)
    warm(pool)
    pairs = [(x, y) for x in axis for y in axis]
    return lambda: list(pool.map(signac_one, pairs, chunksize=50))


def client_map(axis: list[float]) -> Callable[[], None]:
    """Dask: a future a point; nothing is kept."""
    from distributed import Client

    client = Client(n_workers=WORKERS, threads_per_worker=1, dashboard_address="127.0.0.1:0")
    pairs = [(x, y) for x in axis for y in axis]
    return lambda: client.gather(client.map(six_of_pair, pairs))


def region(arguments):
    """Write one point into its region of a Zarr store."""
    import numpy as np
    import xarray as xr

    i, j, x, y = arguments
    values = {name: (("x", "y"), np.array([[v]])) for name, v in zip(NAMES, six(x, y), strict=True)}
    place = {"x": slice(i, i + 1), "y": slice(j, j + 1)}
    xr.Dataset(values).to_zarr("s.zarr", region=place, consolidated=False)


def regions(axis: list[float]) -> Callable[[], None]:
    """xarray: every point its own region, chunk and six writes."""
    import numpy as np
    import xarray as xr

    empty = {name: (("x", "y"), np.full((len(axis), len(axis)), np.nan)) for name in NAMES}
    chunks = {name: {"chunks": (1, 1)} for name in NAMES}
    template = xr.Dataset(empty, coords={"x": axis, "y": axis})
    template.to_zarr("s.zarr", encoding=chunks, consolidated=False, write_empty_chunks=False)
    pool = ProcessPoolExecutor(WORKERS)
    warm(pool)
    places = [(i, j, x, y) for i, x in enumerate(axis) for j, y in enumerate(axis)]
    return lambda: list(pool.map(region, places))


PEERS = {
    "xyzpy crop, batches of 50": lambda axis: crop(50, axis),
    "xyzpy crop, singly": lambda axis: crop(1, axis),
    "joblib with a disk cache": joblib_cache,
    "pipefunc, file store": lambda axis: pipe("file_array", axis),
    "pipefunc, in memory": lambda axis: pipe("dict", axis),
    "signac": signac_project,
    "client.map, a task a point": client_map,
    "Zarr region write a point": regions,
}


def main(name: str, points: int) -> None:
    """Time one peer in a folder of its own."""
    axis = [float(k) for k in range(round(points**0.5))]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        os.chdir(folder)
        sys.path.insert(0, str(Path(__file__).parent))
        work = PEERS[name](axis)
        begun = time.perf_counter()
        work()
        print(len(axis) ** 2 / (time.perf_counter() - begun), flush=True)
        os.chdir(os.sep)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
