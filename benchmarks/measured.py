"""What a benchmark returns, and how processes are timed and watched."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Literal

import psutil

Size = Literal["tiny", "normal", "full"]
LOOK_EVERY_S = 0.2
SWEEP = [sys.executable, "-m", "linksweep"]
ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class Target:
    """What a number is compared with."""

    relation: Literal[">=", "<="]
    value: float

    def holds(self, value: float) -> bool:
        return value >= self.value if self.relation == ">=" else value <= self.value


@dataclass(frozen=True)
class Measured:
    """One number: the median of its ``values``, and its target if there is one."""

    name: str
    values: Sequence[float]
    unit: str = ""
    target: Target | None = None
    note: str = ""

    @property
    def value(self) -> float:
        return median(self.values) if self.values else float("nan")

    @property
    def verdict(self) -> str:
        if self.target is None:
            return ""
        return "holds" if self.target.holds(self.value) else "MISSED"

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "value": self.value, "verdict": self.verdict}


@dataclass
class Watched:
    """What a process and its children took: seconds, CPU seconds of all, the peak resident bytes of the largest, and
    those of the process itself over time.
    """

    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_bytes: int = 0
    own_bytes: list[tuple[float, int]] = field(default_factory=list)
    output: str = ""


def environment() -> dict[str, str]:
    """Return the environment in which commands find the benchmarks and this checkout."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}


def watch(command: Sequence[str], folder: Path, further: Mapping[str, str] | None = None) -> Watched:
    """Run a command to its end, with ``further`` variables in its environment, and watch its process tree.

    Raises RuntimeError with its last words if it fails.
    """
    result, cpu = Watched(), {}
    begun = time.perf_counter()
    process = subprocess.Popen(
        command,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**environment(), **(further or {})},
    )
    over = threading.Event()

    def look() -> None:
        top = psutil.Process(process.pid)
        while not over.is_set():
            try:
                for one in [top, *top.children(recursive=True)]:
                    times, memory = one.cpu_times(), one.memory_info().rss
                    cpu[one.pid] = times.user + times.system
                    result.peak_bytes = max(result.peak_bytes, memory)
                    if one.pid == top.pid:
                        result.own_bytes.append((time.perf_counter() - begun, memory))
            except psutil.Error:  # it has just ended
                pass
            over.wait(LOOK_EVERY_S)

    watcher = threading.Thread(target=look)
    watcher.start()
    result.output, errors = process.communicate()
    over.set()
    watcher.join()
    result.seconds, result.cpu_s = time.perf_counter() - begun, sum(cpu.values())
    if process.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}: exit code {process.returncode}: {errors[-2000:]}")
    return result


def host_load() -> float:
    """Return how many processes want to run on each core, one-minute average: far above 1 no time means much."""
    return os.getloadavg()[0] / (os.cpu_count() or 1)
