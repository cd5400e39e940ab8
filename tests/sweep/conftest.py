"""A real S3 server on this machine, as a process; small real stores of the built-in studies, each run once."""

import socket
import subprocess
import sys
import time
from fcntl import LOCK_EX, flock
from urllib.request import Request, urlopen
from uuid import uuid4

import pytest
import xarray as xr

import linksweep
from tests.conftest import LINK_STUDY
from tests.tiers import slow

SHORT = {  # settings and axes of built-in studies
    **dict.fromkeys(("quasars", "sqrt-n"), ("n_sim=20 n_cat=10", "")),
    **dict.fromkeys(("mission-length", "radio-stars"), ("n_sim=10 n_cat=20", "")),
    **{"galaxies": ("n_sim=10 n_cat=10", ""), "scatter": ("n_sim=1000", ""), "algorithm": ("n_cat=4", "")},
    **{"icrf2-icrf3": ("n_sim=2", ""), "pulsar-timing": ("n_sim=20", "")},
    "pulsar-forecast": ("n_sim=100", "n_new=5,62"),
    "error-surface": ("n_sim=10 n_cat=4", "reference_error_scale=0:4:1"),
    **{"grid": ("n_sim=10 n_cat=2", "v_max=16,17"), "aberration": ("n_sim=4 n_cat=4", "v_max=14,15,16,18")},
    "degree-two": ("n_sim=4 n_cat=5", "n_obj=30,100 motion_field=t_2_0,s_2_1_re"),
    "zonal-errors": ("n_sim=16 n_cat=5", "n_obj=30,100 zonal_length=15,60"),
    **{"magnitude-equation": ("n_sim=4 n_cat=5", "v_max=15,16"), "error-budget": ("n_sim=4 n_cat=5", "v_max=14,15")},
}


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="session")
def s3_endpoint():
    port = free_port()
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen([sys.executable, "-m", "tests.s3_server", str(port)], **quiet)
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            break
        except OSError:
            assert server.poll() is None, "the S3 server has ended"
            time.sleep(0.05)
    yield f"http://127.0.0.1:{port}"
    server.terminate()
    server.wait()


def make_bucket(endpoint, name):
    with urlopen(Request(f"{endpoint}/{name}", method="PUT")) as answer:
        assert answer.status == 200


@pytest.fixture
def bucket(s3_endpoint, monkeypatch):
    name = f"bucket-{uuid4().hex[:12]}"
    make_bucket(s3_endpoint, name)
    words = {"ENDPOINT_URL": s3_endpoint, "ACCESS_KEY_ID": "someone", "SECRET_ACCESS_KEY": "secret"}
    for key, value in (words | {"REGION": "us-east-1"}).items():
        monkeypatch.setenv(f"AWS_{key}", value)
    return f"s3://{name}"


@pytest.fixture(params=["folder", slow("bucket")])
def place(request, tmp_path):
    """Where a store may be: a path, and an address in a bucket."""
    if request.param == "folder":
        return str(tmp_path / "place" / "s.zarr")
    return request.getfixturevalue("bucket") + "/place/s.zarr"


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    (folder / "small.toml").write_text(LINK_STUDY)
    assert linksweep.run(folder / "small.toml", folder / "serial.zarr", pool="serial").attrs["complete"]
    return xr.open_zarr(folder / "serial.zarr").load()


@pytest.fixture(scope="session")
def store_of(tmp_path_factory, worker_id):
    """A function that returns the store of a built-in study, run with fewer realisations, once for all workers."""
    ours = tmp_path_factory.getbasetemp()
    folder = (ours if worker_id == "master" else ours.parent) / "stores"
    folder.mkdir(exist_ok=True)

    def run(name):
        path = folder / f"{name}.zarr"
        with (folder / name).open("w") as file:
            flock(file, LOCK_EX)
            if not path.exists():
                linksweep.run(linksweep.load_study(name, *map(str.split, SHORT[name])), path, pool="serial")
        return path

    return run


@pytest.fixture
def dataset_of(store_of):
    from tests.sweep.opening import OpenStore

    return lambda name: OpenStore(store_of(name)).dataset()
