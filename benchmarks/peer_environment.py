"""An environment with the packages that linksweep is measured beside, in the user's cache folder, made once."""

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

PACKAGES = (
    "xyzpy",
    "matplotlib",
    "h5netcdf",
    "joblib",
    "pipefunc",
    "signac",
    "distributed",
    "xarray",
    "zarr",
    "cloudpickle",
    "scipy",
    "pvlib",
)


def environment() -> Path:
    """Return the Python of the environment, made if there is none of these packages."""
    digest = hashlib.sha256(" ".join(PACKAGES).encode()).hexdigest()[:8]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / f"linksweep-benchmarks-{digest}"
    python = cache / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not (cache / "ready").exists():
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-m", "venv", str(cache)], check=True)
        for package in PACKAGES:  # one that cannot be installed leaves the others
            subprocess.run([str(python), "-m", "pip", "install", "-q", package], check=False, stderr=subprocess.DEVNULL)
        (cache / "ready").touch()
        print(f"peers installed into {cache} in {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    return python
