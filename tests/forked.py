"""Processes of `sweep` that need not import what each of them imports: forked from one that has.

``python -m tests.forked ADDRESS`` waits at a Unix socket; it imports when it is first asked.  A request is a JSON
document on a line, and its answer the exit code of its process.
"""

import atexit
import gc
import importlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path
from typing import Any

from tests.patience import PATIENCE_S

IMPORTED = (
    *("sweep.cli", "sweep.running.run", "sweep.executing.clusters", "dask.array", "distributed.deploy", "pandas"),
    *("core.experiment", "rich.progress", "rich.table", "pyarrow", "scipy.stats", "sweep.analysis.laws"),
    *("matplotlib.backends.backend_agg", "sweep.plots.figure", "sweep.report.page", "sweep.tie.setup"),
    *("astropy.table", "astropy.time", "astropy.io.ascii", "astropy.io.fits"),
)
"""What commands take, most of their CPU time if they do little."""


class Nursery:
    """The process that has imported, and starts others; all processes of a session of tests share it."""

    def __init__(self) -> None:
        self._folder = tempfile.mkdtemp()
        self.address = f"{self._folder}/socket"
        command = [sys.executable, "-m", "tests.forked", self.address]
        self._process = subprocess.Popen(command, cwd=Path(__file__).parent.parent, start_new_session=True)

    def close(self) -> None:
        """End it, and whatever it has started."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        shutil.rmtree(self._folder)


def run(address: str, *arguments: Any, cwd: Any = None) -> tuple[int, str, str]:
    """Run ``sweep`` with these arguments to its end; return exit code, standard output and standard error."""
    with tempfile.TemporaryDirectory() as folder, connected(address) as connection:
        request = {
            "arguments": [str(a) for a in arguments],
            "cwd": str(cwd or Path.cwd()),
            "environment": dict(os.environ),
            "folder": folder,
        }
        connection.settimeout(PATIENCE_S)
        with connection.makefile("rw") as stream:
            print(json.dumps(request), file=stream, flush=True)
            code = int(stream.readline())
        out, err = ((Path(folder) / name).read_bytes().decode() for name in ("out", "err"))
        return code, out, err


def connected(address: str) -> socket.socket:
    """Return a connection to the process that has imported, which may just have been started."""
    start = time.monotonic()
    while True:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(address)
            return connection
        except (FileNotFoundError, ConnectionRefusedError):
            connection.close()
            assert time.monotonic() < start + PATIENCE_S, f"nothing at {address}"
            time.sleep(0.05)


def serve(address: str) -> dict[str, Any]:
    """Answer requests until this process is killed; return the request in each process that is to carry it out."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen(128)
        connection, _ = listener.accept()
        for name in IMPORTED:
            importlib.import_module(name)
        gc.collect()
        gc.freeze()  # a collection in a forked process would touch, and so copy, all that is imported
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those who answer
        while os.fork():
            connection.close()
            connection, _ = listener.accept()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    with connection, connection.makefile("rw") as stream:
        request: dict[str, Any] = json.loads(stream.readline())
        if child := os.fork():
            print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=stream, flush=True)
            os._exit(0)
    return request


def become(request: dict[str, Any]) -> None:
    """Turn this process into one that was started for the request."""
    os.setsid()
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[0] = request["cwd"]
    sys.argv = ["sweep", *request["arguments"]]
    for descriptor, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(f"{request['folder']}/{name}", os.O_WRONLY | os.O_CREAT), descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    warnings.simplefilter("default")


def end(code: Any) -> None:
    """End this process as Python does, without taking its modules apart: that would copy nearly all of its memory."""
    if isinstance(code, str):
        print(code, file=sys.stderr)
        code = 1
    threading._shutdown()  # type: ignore[attr-defined]  # waits for the threads
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(code or 0)


if __name__ == "__main__":
    become(serve(sys.argv[1]))
    from sweep.cli import main
    from sweep.cli.streams import prepare_streams

    prepare_streams()
    try:
        main(prog_name="sweep")
    except SystemExit as ended:
        end(ended.code)
