"""A Dask scheduler and workers as processes of their own, started from Dask's command line."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import psutil

from tests.tiers import PATIENCE_S


class Outside:
    def __init__(self, folder: Path, *options: str, protocol: str = "tcp") -> None:
        self.folder, self.options = folder, options
        self.processes: list[subprocess.Popen] = []
        file = folder / "scheduler.json"
        arguments = ("--host", "127.0.0.1", "--port", "0", "--protocol", protocol, "--scheduler-file", str(file))
        self.scheduler = self._start("dask_scheduler", *arguments, "--no-dashboard", *options)
        try:
            self.address = wait_until(lambda: address_in(file), "a scheduler")
        except BaseException:
            self.close()
            raise

    def start_worker(self, *options: str, before: Sequence[str] = (), **environment: str) -> subprocess.Popen:
        arguments = (self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard")
        options = ("--local-directory", str(self.folder), *self.options, *options)
        return self._start("dask_worker", *arguments, *options, before=before, **environment)

    def wait_for_workers(self, count: int) -> None:
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=PATIENCE_S)

    def _start(self, command: str, *arguments: str, before: Sequence[str] = (), **environment: str) -> subprocess.Popen:
        words = [*before, sys.executable, "-m", f"distributed.cli.{command}", *arguments]
        with (self.folder / f"{command}.log").open("a") as log:
            how = {"stdout": log, "stderr": log, "start_new_session": True}
            self.processes.append(subprocess.Popen(words, env=os.environ | environment, **how))
        return self.processes[-1]

    def kill(self, *processes: subprocess.Popen) -> None:
        for process in processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self.processes.remove(process)

    def close(self) -> None:
        self.kill(*self.processes[::-1])


def address_in(file: Path) -> str | None:
    with suppress(FileNotFoundError, json.JSONDecodeError):
        return json.loads(file.read_text())["address"]
    return None


def wait_until(true, what, seconds=PATIENCE_S):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if result := true():
            return result
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds} s for {what}")


def below(pid):
    with suppress(psutil.NoSuchProcess):
        return {child.pid for child in psutil.Process(pid).children(recursive=True)}
    return set()


def workers_below(pid):
    """Return the worker processes of a run: copies of its process, and those that Dask's nannies started."""
    ours = command_of(pid)
    return [child for child in sorted(below(pid)) if command_of(child) == ours or "spawn_main" in command_of(child)]


def _connections(pids, kind):
    for pid in pids:
        with suppress(psutil.NoSuchProcess):
            yield from psutil.Process(pid).net_connections(kind)


def listening(pids):
    return [tuple(one.laddr) for one in _connections(pids, "inet") if one.status == psutil.CONN_LISTEN]


def unix_sockets(pids):
    return [one.laddr for one in _connections(pids, "unix") if one.laddr]


def command_of(pid):
    with suppress(psutil.NoSuchProcess):
        return " ".join(psutil.Process(pid).cmdline())
    return ""
