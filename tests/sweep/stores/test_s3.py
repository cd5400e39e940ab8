"""Stores in a bucket, with a real server on this machine and faults on the way to it."""

import random
import socket
import sys
import threading
from urllib.parse import urlsplit

import pytest
import xarray as xr
from zarr.storage import ObjectStore

import linksweep
from linksweep import SweepError
from tests.documents import run_commands
from tests.sweep import opening
from tests.sweep.conftest import make_bucket
from tests.sweep.opening import OFTEN, existing_store, located, run, same
from tests.tiers import slow


class Proxy:
    """Passes connections on to a server; what ``fault`` says happens to a request instead.

    ``fault`` is called with the number of the request and returns None, "reset" (the connection breaks before the
    server hears of it), "lost" (the server does it, but its answer never comes) or "503".
    """

    def __init__(self, server, fault=lambda number: None):
        self._server = (urlsplit(server).hostname, urlsplit(server).port)
        self.requests, self.faults, self._fault = [], 0, fault
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, client):
        with client, socket.create_connection(self._server) as server, client.makefile("rb") as requests:
            answers = server.makefile("rb")
            while True:
                try:
                    head, body = read_message(requests)
                except OSError:
                    return
                if not head:
                    return
                self.requests.append(head.split(b"\r\n")[0].decode())
                fault = self._fault(len(self.requests))
                self.faults += fault is not None
                if fault == "reset":
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                    return
                if fault == "503":
                    client.sendall(b"HTTP/1.1 503 Slow Down\r\nContent-Length: 0\r\n\r\n")
                    continue
                server.sendall(head + body)
                answer = b"".join(read_message(answers, to_head=head.startswith(b"HEAD")))
                if fault == "lost":
                    return
                client.sendall(answer)

    def close(self):
        self._listener.close()


def read_message(stream, to_head=False):
    """Return head and body of an HTTP message."""
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        line = stream.readline()
        if not line:
            return b"", b""
        head += line
    fields = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:] if b": " in line)
    if b"chunked" in fields.get(b"transfer-encoding", b""):
        body = b""
        while (line := stream.readline()) != b"0\r\n":
            body += line + stream.read(int(line, 16) + 2)
        return head, body + line + stream.readline()
    return head, b"" if to_head else stream.read(int(fields.get(b"content-length", 0)))


@pytest.fixture
def through(s3_endpoint, bucket, monkeypatch):
    """A function that puts a proxy with faults before the server of the bucket."""
    proxies = []

    def make(fault=lambda number: None):
        proxies.append(Proxy(s3_endpoint, fault))
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxies[-1].endpoint)
        return proxies[-1]

    yield make
    for proxy in proxies:
        proxy.close()


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
    methods = {line.split()[0] for line in proxy.requests}
    assert methods == {"GET", "PUT", "POST"}  # POST: deletion of the lock


@pytest.mark.parametrize("kind", ["reset", slow("lost"), slow("503")])
def test_requests_that_fail_are_repeated(bucket, coins, wanted, through, kind):
    chance = random.Random(11)
    proxy = through(lambda number: kind if chance.random() < 0.15 else None)
    same(run(coins, f"{bucket}/s.zarr"), wanted)
    assert proxy.faults > 5
    through()
    same(linksweep.open(f"{bucket}/s.zarr"), wanted)
    assert located(bucket + "/x").parent.get("s.zarr.lock") is None


@pytest.mark.slow  # requests are repeated for seconds
def test_a_connection_that_breaks_for_good_keeps_what_was_finished(bucket, coins, wanted, through, monkeypatch):
    monkeypatch.setattr(opening.location, "TIMEOUT", opening.location.TIMEOUT / 10)
    proxy = through(lambda number: "reset" if len(proxy.requests) > 60 else None)
    with pytest.raises(SweepError, match=r"cannot be (read|written): .* does not answer as it should"):
        run(coins, f"{bucket}/s.zarr", OFTEN)
    through()
    assert 0 < len(existing_store(f"{bucket}/s.zarr", coins).rows) < 6 * 4
    with pytest.raises(SweepError, match="is being written by process"):  # by us, who could not remove the lock
        run(coins, f"{bucket}/s.zarr")
    same(run(coins, f"{bucket}/s.zarr", break_lock=True), wanted)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        slow({"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "http://127.0.0.1:9 does not answer as it should"),
        ({"AWS_ENDPOINT_URL": "http://192.0.2.1"}, "not encrypted; AWS_ALLOW_HTTP=true"),
        ({"bucket": "s3://there-is-none"}, "there is no bucket 'there-is-none'"),
        slow(
            {"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None},
            "there are no credentials; set AWS_ACCESS_KEY_ID",
        ),
        ({"bucket": "s3://ab"}, "its address must be s3://BUCKET/NAME"),
    ],
)
def test_what_does_not_work_is_said_in_a_sentence(bucket, link_study, sweep, monkeypatch, change, words):
    store = change.get("bucket", bucket) + "/s.zarr"
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")  # no credentials from this machine either
    for name, value in (pair for pair in change.items() if pair[0] != "bucket"):
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    code, out, err = sweep("run", link_study, "-o", store)
    assert (code, out) == (2, ""), err
    assert err.startswith("error: ")
    assert words in err
    assert len(err.strip().splitlines()) == 1


def test_obstore_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(SweepError, match=r"pip install 'linksweep\[s3\]'"):
        located("s3://abc/x")
