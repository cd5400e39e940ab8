"""Lets one run at a time write to a store: a file ``STORE.lock`` beside it names the process that does.

A lock whose process on this host has ended is taken over.  Whether a process on another host runs cannot be told from
here, so its lock is broken only on request.
"""

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal
from uuid import uuid4

from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import command_line, host, now
from linksweep.sweep.stores.location import TAKING, Location, Where, located, reading, writing

ATTEMPTS, PAUSE_S = 100, 0.02


@dataclass(frozen=True)
class Holder:
    """Who holds a lock.

    ``boot`` distinguishes hosts of the same name, and processes before and after a restart; ``started``, in ticks of
    the kernel since the boot, distinguishes a process from a later one with the same number.  Both are empty where the
    system has no /proc.
    """

    host: str
    boot: str
    pid: int
    started: str
    since: str
    command: str
    token: str

    def __str__(self) -> str:
        command = f" ({self.command})" if self.command else ""
        return f"process {self.pid} on {self.host}, since {self.since}{command}"

    def state(self) -> Literal["runs", "has ended", "cannot be judged"]:
        """Say whether the holder runs, as far as that can be told on this host."""
        if (self.host, self.boot) != _this_host():
            return "cannot be judged"
        if self.started:
            return "runs" if _start_of(self.pid) == self.started else "has ended"
        import psutil

        return "runs" if psutil.pid_exists(self.pid) else "has ended"


@contextmanager
def locked(where: Where, *, break_lock: bool = False) -> Iterator[None]:
    """Hold the lock of a store; raises SweepError that names the holder where another process has it.

    ``break_lock`` takes it from a holder that cannot be judged, never from another process that runs on this host.
    """
    location = located(where)
    mine = Holder(*_this_host(), os.getpid(), _start_of(os.getpid()), now(), command_line(), uuid4().hex)
    with location.parent.tidied():
        with writing(location):
            _take(location, mine, break_lock)
        try:
            yield
        finally:
            with suppress(OSError):  # the next run finds that this process has ended
                if _read(location) == mine:
                    location.parent.delete(_key(location))


def holder(where: Where) -> Holder | None:
    """Return who holds the lock of a store, None where nobody does or its process is known to have ended."""
    location = located(where)
    with reading(location):
        found = _read(location)
    return None if found is None or found.state() == "has ended" else found


def is_left_over(where: Where) -> bool:
    """Return whether a process that has ended left its lock: it was killed."""
    location = located(where)
    with reading(location):
        return _read(location) is not None and holder(location) is None


def _take(location: Location, mine: Holder, break_lock: bool) -> None:
    key, content = _key(location), json.dumps(asdict(mine), indent=1).encode()
    for _ in range(ATTEMPTS):
        if location.parent.create(key, content):
            return
        held = location.parent.get(key)
        if held is None:
            continue  # released just now
        if held == content:
            return  # a request that was repeated after its answer was lost
        _refuse_unless_free(location, _parsed(held), break_lock)
        if location.parent.swap(key, held, content):
            return
        time.sleep(PAUSE_S)  # another process takes it over
    raise SweepError(
        f"its lock {key} keeps changing hands; if no other process runs there, remove {key} and {key}{TAKING}",
        str(location),
    )


def _refuse_unless_free(location: Location, other: Holder | None, break_lock: bool) -> None:
    where = str(location)
    if other is None:
        if not break_lock:
            raise SweepError(
                f"its lock {_key(location)} beside it is damaged; if no run writes to it, give --break-lock", where
            )
        return
    state = other.state()
    if state == "runs" and not (break_lock and other.pid == os.getpid()):
        more = "; --break-lock is only for a lock whose process has ended" if break_lock else ""
        raise SweepError(f"is being written by {other}{more}", where)
    if state == "cannot be judged" and not break_lock:
        raise SweepError(
            f"is being written by {other}. Whether that still runs cannot be told from here; if it does not, "
            "the same command with --break-lock goes on",
            where,
        )


def _key(location: Location) -> str:
    return f"{location.name}.lock"


def _read(location: Location) -> Holder | None:
    content = location.parent.get(_key(location))
    return None if content is None else _parsed(content)


def _parsed(content: bytes) -> Holder | None:
    with suppress(ValueError, TypeError):
        return Holder(**json.loads(content))
    return None


def _this_host() -> tuple[str, str]:
    """Return the host's name, and what identifies the boot of its kernel and the PID namespace of this process."""
    boot = ""
    with suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        boot += " " + str(Path("/proc/self/ns/pid").readlink())
    return host(), boot


def _start_of(pid: int) -> str:
    """Return when a running process was started, in ticks since the boot; empty where no such process runs."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if state in "ZX" else rest[18]
