"""Stores in a bucket, with a real server on this machine and faults on the way to it."""

import os
import random
import signal
import socket
import threading
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

import pytest
import xarray as xr
from zarr.storage import ObjectStore

import linksweep
from linksweep import SweepError
from tests.documents import run_commands
from tests.sweep.conftest import make_bucket
from tests.sweep.opening import OFTEN, existing_store, located, location, run, same
from tests.tiers import slow

WRONG = {  # what is said of which bucket and variables of the environment
    "http://127.0.0.1:9 does not answer as it should": {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"},
    "there are no credentials; set AWS_ACCESS_KEY_ID": {"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None},
    "not encrypted; AWS_ALLOW_HTTP=true": {"AWS_ENDPOINT_URL": "", "AWS_ENDPOINT": "http://192.0.2.1"},
    "AWS_ENDPOINT_URL is '127.0.0.1:9', not an address": {"AWS_ENDPOINT_URL": "127.0.0.1:9"},
    "there is no bucket 'there-is-none'": {"bucket": "s3://there-is-none"},
}


class Passing(BaseHTTPRequestHandler):
    """Passes a request on to the server of a proxy, unless a fault happens to it."""

    protocol_version = "HTTP/1.1"

    def pass_on(self):
        proxy, body = self.server, self.rfile.read(int(self.headers.get("content-length", 0)))
        proxy.requests.append(self.command)
        fault = proxy.fault(len(proxy.requests))
        proxy.faults += fault is not None
        if fault == "503":
            self.send_error(503)
        elif fault == "reset":
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            self.connection.close()
            self.close_connection = True
        else:
            server = HTTPConnection(proxy.server)
            server.request(self.command, self.path, body, dict(self.headers))
            answer = server.getresponse()
            content = answer.read()
            server.close()
            if fault == "lost":
                self.close_connection = True
                return
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ("transfer-encoding", "connection", "date", "server"):
                    self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

    do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = pass_on  # noqa: N815

    def log_message(self, *_):
        """Print nothing."""


@pytest.fixture
def through(s3_endpoint, bucket, monkeypatch):
    """A function that puts a proxy before the server: ``fault`` of a request's number is None, a reset, lost or 503."""
    proxies = []

    def make(fault=lambda number: None):
        proxy = ThreadingHTTPServer(("127.0.0.1", 0), Passing)
        proxy.server, proxy.fault, proxy.requests, proxy.faults = urlsplit(s3_endpoint).netloc, fault, [], 0
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        proxies.append(proxy)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{proxy.server_port}")
        return proxy

    yield make
    for proxy in proxies:
        proxy.shutdown()
        proxy.server_close()


@pytest.fixture
def wanted(coins, tmp_path):
    return run(coins, tmp_path / "wanted.zarr")


def test_a_store_in_a_bucket_is_that_in_a_folder(bucket, coins, wanted, tmp_path):
    store = f"{bucket}/results/s.zarr"
    same(run(coins, store), wanted)
    same(linksweep.open(store), wanted)
    same(xr.open_zarr(ObjectStore(located(store).objects, read_only=True)).load(), wanted)
    names = located(store).keys()
    assert names == located(tmp_path / "wanted.zarr").keys()
    assert located(f"{bucket}/results").keys() == [f"s.zarr/{name}" for name in names]  # no lock is left
    large = {"axes": {"k": [1, 2]}, "workers": 2}  # forks of a process that has used the bucket
    same(*(linksweep.run(lambda k: [float(k)] * 600_000, to, **large) for to in (f"{bucket}/l.zarr", tmp_path / "l")))


@pytest.mark.slow
def test_the_commands_of_the_document_run(bucket, s3_endpoint, sweep, tmp_path):
    make_bucket(s3_endpoint, "my-bucket")
    run_commands("stores.md", sweep, tmp_path)
    same(linksweep.open("s3://my-bucket/results/quasars.zarr"), linksweep.open(tmp_path / "results" / "quasars.zarr"))


@pytest.mark.slow
def test_a_small_run_needs_few_requests(bucket, coins, through):
    proxy = through()
    run(coins, f"{bucket}/s.zarr")
    before = len(proxy.requests)
    arrays = len(linksweep.open(f"{bucket}/s.zarr").variables)
    assert before < 45 + 4 * arrays  # each array's chunk and document are written at the start and at the end
    assert len(proxy.requests) - before <= 2 + arrays
    assert set(proxy.requests) == {"GET", "PUT", "POST"}  # POST: deletion of the lock


@pytest.mark.parametrize("kind", [slow("reset"), slow("lost"), slow("503")])
def test_requests_that_fail_are_repeated(bucket, coins, wanted, through, kind):
    chance = random.Random(11)
    proxy = through(lambda number: kind if chance.random() < 0.15 else None)
    same(run(coins, f"{bucket}/s.zarr"), wanted)
    assert proxy.faults > 5
    through()
    same(linksweep.open(f"{bucket}/s.zarr"), wanted)
    assert located(bucket + "/x").parent.get("s.zarr.lock") is None


@pytest.mark.slow  # requests are repeated for seconds
@pytest.mark.parametrize("error", [SweepError, KeyboardInterrupt])  # Ctrl-C while a request is repeated
def test_a_connection_that_breaks_for_good_keeps_what_was_finished(bucket, coins, wanted, through, monkeypatch, error):
    monkeypatch.setattr(location, "TIMEOUT", location.TIMEOUT / 10)
    interrupt = {60: lambda: os.kill(os.getpid(), signal.SIGINT)} if error is KeyboardInterrupt else {}
    through(lambda number: "reset" if interrupt.get(number, bool)() or number >= 60 else None)
    match = "same call" if interrupt else r"cannot be written: .* not answer as it should.* same command goes on"
    with pytest.raises(error, match=match):
        run(coins, f"{bucket}/s.zarr", OFTEN)
    through()
    assert 0 < len(existing_store(f"{bucket}/s.zarr", coins).rows) < 6 * 4
    with pytest.raises(SweepError, match="is being written by process"):  # by us, who could not remove the lock
        run(coins, f"{bucket}/s.zarr")
    same(run(coins, f"{bucket}/s.zarr", break_lock=True), wanted)


@pytest.mark.parametrize("words", [*map(slow, [*WRONG][:2]), *[*WRONG][2:]])
def test_what_does_not_work_is_said_in_a_sentence(bucket, link_study, sweep, monkeypatch, words):
    change = WRONG[words]
    store = change.get("bucket", bucket) + "/s.zarr"
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")  # no credentials from this machine either
    for name, value in (pair for pair in change.items() if pair[0] != "bucket"):
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    code, out, err = sweep("run", link_study, "-o", store)
    assert (code, out, words in err, err[:7], err.count("\n")) == (2, "", True, "error: ", 1), err
