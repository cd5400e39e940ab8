"""Processes of `sweep` that need not import what each of them imports: forked from one that has.

``python -m tests.forked`` reads requests, a JSON document a line, and answers each with the exit code of its process.
"""

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from pathlib import Path
from typing import Any

IMPORTED = ("sweep.cli", "sweep.running.run", "sweep.executing.clusters", "dask.array", "distributed.deploy", "pandas")
"""What nearly every command takes, most of its CPU time if it does little."""

LONGEST_S = 1200.0


class Nursery:
    """The process that has imported, and starts others."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.forked"]
        self._process = subprocess.Popen(
            command,
            cwd=Path(__file__).parent.parent,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(self, *arguments: Any, cwd: Any = None) -> tuple[int, str, str]:
        """Run ``sweep`` with these arguments to its end; return exit code, standard output and standard error."""
        assert self._process.stdin
        assert self._process.stdout
        with tempfile.TemporaryDirectory() as folder:
            request = {
                "arguments": [str(a) for a in arguments],
                "cwd": str(cwd or Path.cwd()),
                "environment": dict(os.environ),
                "folder": folder,
            }
            late = threading.Timer(LONGEST_S, self.close)
            late.start()
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            code = self._process.stdout.readline()
            late.cancel()
            assert code, f"sweep {' '.join(request['arguments'])} took longer than {LONGEST_S:g} s"
            out, err = ((Path(folder) / name).read_bytes().decode() for name in ("out", "err"))
            return int(code), out, err

    def close(self) -> None:
        """End it, and whatever it has started."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()


def serve() -> dict[str, Any]:
    """Answer requests until there are no more; return the request in each process that is to carry it out."""
    for name in IMPORTED:
        importlib.import_module(name)
    for line in sys.stdin:
        child = os.fork()
        if not child:
            request: dict[str, Any] = json.loads(line)
            return request
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    sys.exit()


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


if __name__ == "__main__":
    become(serve())
    from sweep.cli import main
    from sweep.cli.streams import prepare_streams

    prepare_streams()
    main(prog_name="sweep")
