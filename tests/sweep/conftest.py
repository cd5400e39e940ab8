"""A real S3 server on this machine, as a process."""

import socket
import subprocess
import sys
import time
from urllib.request import Request, urlopen
from uuid import uuid4

import pytest


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="session")
def s3_endpoint():
    """The address of an S3 server that runs for the whole session."""
    port = free_port()
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], **quiet)
    deadline = time.monotonic() + 60
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            break
        except OSError:
            assert time.monotonic() < deadline, "the S3 server does not start"
            assert server.poll() is None, "the S3 server has ended"
            time.sleep(0.05)
    yield f"http://127.0.0.1:{port}"
    server.terminate()
    server.wait(timeout=30)


@pytest.fixture
def bucket(s3_endpoint, monkeypatch):
    """The address of a new bucket, with endpoint and credentials in the environment."""
    name = f"bucket-{uuid4().hex[:12]}"
    with urlopen(Request(f"{s3_endpoint}/{name}", method="PUT")) as answer:
        assert answer.status == 200
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "someone")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    return f"s3://{name}"


@pytest.fixture(params=["folder", "bucket"])
def place(request, tmp_path):
    """Where a store may be: a path, and an address in a bucket."""
    if request.param == "folder":
        return str(tmp_path / "place" / "s.zarr")
    return request.getfixturevalue("bucket") + "/place/s.zarr"
