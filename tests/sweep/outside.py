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

from tests.tiers import PATIENCE_S


class Outside:
    """A scheduler on loopback, and workers that come and go."""

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
        """Start a worker of one thread with its nanny; ``before`` is a command that runs it."""
        arguments = (self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard", "--local-directory")
        return self._start(
            "dask_worker", *arguments, str(self.folder), *self.options, *options, before=before, **environment
        )

    def wait_for_workers(self, count: int) -> None:
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=PATIENCE_S)

    def _start(self, command: str, *arguments: str, before: Sequence[str] = (), **environment: str) -> subprocess.Popen:
        with (self.folder / f"{command}.log").open("a") as log:
            process = subprocess.Popen(
                [*before, sys.executable, "-m", f"distributed.cli.{command}", *arguments],
                env=os.environ | environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.processes.append(process)
        return process

    def kill(self, *processes: subprocess.Popen) -> None:
        for process in processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self.processes.remove(process)

    def close(self) -> None:
        self.kill(*self.processes[::-1])


def address_in(file: Path) -> str | None:
    """Return the address in a scheduler file, None until it has been written to its end."""
    try:
        return json.loads(file.read_text())["address"]
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def wait_until(true, what, seconds=PATIENCE_S):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := true():
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited {seconds} s for {what}")


def parents():
    found = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            found[int(pid)] = int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
    return found


def below(pid):
    """Return the processes that a process started, and those that these started."""
    of = parents()
    found = {pid}
    while more := {child for child, parent in of.items() if parent in found} - found:
        found |= more
    return found - {pid}


def workers_below(pid):
    """Return the worker processes of a run: copies of its process, and those that Dask's nannies started."""
    own = command_of(pid)
    return [child for child in sorted(below(pid)) if command_of(child) == own or "spawn_main" in command_of(child)]


def listening(pids):
    """Return the addresses, as /proc prints them, and the ports on which these processes listen."""
    inodes = _sockets_of(pids)
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    pairs = [line[1].split(":") for line in lines if line[3] == "0A" and line[9] in inodes]
    return [(address, int(port, 16)) for address, port in pairs]


def unix_sockets(pids):
    """Return the names of the sockets of these processes that have one; '@' begins those that are no files."""
    inodes = _sockets_of(pids)
    lines = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
    return [line[7] for line in lines if len(line) > 7 and line[6] in inodes]


def _sockets_of(pids):
    inodes = set()
    for link in (link for pid in pids for link in Path(f"/proc/{pid}/fd").glob("*")):
        with suppress(OSError):  # it is closed by now
            inodes.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
    return inodes


def command_of(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""
