"""A Dask scheduler and many worker processes on this machine, forked from one that has imported what they need.

``python -m benchmarks.many_workers WORKERS THREADS LIFETIME`` prints the scheduler's address and runs until its input
is closed.  With a LIFETIME above 0 a worker is killed every so many seconds, and another one starts.
"""

import asyncio
import os
import random
import select
import signal
import sys
import time

import dask
from distributed import Scheduler, Worker

import linksweep.sweep.executing.clusters  # noqa: F401, imported before the forks
from linksweep.sweep.executing.task import Identity

dask.config.set(
    {  # what idle processes look at every few milliseconds, 64 of which would keep two cores busy
        "distributed.admin.tick.interval": "5s",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.profile.enabled": False,
    }
)


async def serve_tasks(address: str, threads: int) -> None:
    """Work until the scheduler says that it is enough."""
    async with Worker(address, nthreads=threads, memory_limit=0, dashboard=False) as worker:
        await worker.finished()


async def schedule(address_pipe: int) -> None:
    """Schedule for ever."""
    async with Scheduler(host="127.0.0.1", port=0, dashboard=False) as scheduler:
        os.write(address_pipe, scheduler.address.encode())
        os.close(address_pipe)
        await scheduler.finished()


def forked(serve, *arguments) -> int:
    """Run a coroutine function in a child process; return its number."""
    if (child := os.fork()) == 0:
        try:
            asyncio.run(serve(*arguments))
        finally:
            os._exit(0)
    return child


def main(workers: int, threads: int, lifetime_s: float) -> None:
    """Start them, replace some, end them."""
    Identity.here("benchmarks.sleepers:experiment")  # versions are read once, and not by 64 processes on two cores
    read, write = os.pipe()
    processes = [forked(schedule, write)]
    os.close(write)
    address = os.read(read, 200).decode()
    processes += [forked(serve_tasks, address, threads) for _ in range(workers)]
    print(address, flush=True)
    turn = lifetime_s or 1.0
    while not select.select([sys.stdin], [], [], turn)[0]:
        if lifetime_s:
            victim = random.randrange(1, len(processes))
            os.kill(processes[victim], signal.SIGKILL)
            os.waitpid(processes[victim], 0)
            processes[victim] = forked(serve_tasks, address, threads)
    for process in processes:
        os.kill(process, signal.SIGKILL)
    time.sleep(0.1)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
