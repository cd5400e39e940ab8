"""The options that say what a command runs on: workers, pools, clusters and limits."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from linksweep.sweep.cli.options import gathered
from linksweep.sweep.executing.pools import DEFAULT_POOL, POOLS

if TYPE_CHECKING:
    from linksweep.sweep.executing.pools import PoolName, Resources

EXISTING = click.Path(exists=True, dir_okay=False, path_type=Path)

MEMORY_AT_LEAST = 200 * 10**6
"""Bytes that a worker needs for itself."""


def _bytes(_context: click.Context, _parameter: click.Parameter, value: str | None) -> int | None:
    if value is None:
        return None
    from dask.utils import parse_bytes

    try:
        number = int(parse_bytes(value))
    except ValueError as error:
        raise click.BadParameter(f"{value!r} is no number of bytes; write 2GB or 500MiB") from error
    if number < MEMORY_AT_LEAST:
        raise click.BadParameter(f"{value!r} is less than the {MEMORY_AT_LEAST // 10**6} MB that a worker needs itself")
    return number


def _resources(
    workers: int | None,
    pool: "PoolName | None",
    scheduler: str | None,
    tls_ca: Path | None,
    tls_cert: Path | None,
    tls_key: Path | None,
    cluster: Path | None,
    time_limit: float | None,
    memory_limit: int | None,
    dashboard: bool,
) -> "Resources":
    """Return what to run on; raises click.UsageError for options that contradict each other."""
    from linksweep.sweep.executing.pools import Limits, Resources

    if scheduler is not None and cluster is not None:
        raise click.UsageError("--scheduler and --cluster are two places; name one")
    local = workers is not None or pool is not None or memory_limit is not None
    if local and (scheduler or cluster):
        elsewhere = "--scheduler" if scheduler else "--cluster"
        raise click.UsageError(
            f"--workers, --pool and --memory-limit are for local workers; they do not go with {elsewhere}"
        )
    if workers is not None and pool is not None and not POOLS[pool].has_workers:
        raise click.UsageError(f"--pool {pool} has no workers")
    tls = (tls_ca, tls_cert, tls_key) if tls_ca and tls_cert and tls_key else None
    any_tls = tls_ca or tls_cert or tls_key
    if any_tls and (tls is None or scheduler is None or not scheduler.startswith("tls://")):
        raise click.UsageError("--tls-ca, --tls-cert and --tls-key go together, and with --scheduler tls://HOST:PORT")
    return Resources(workers, pool, scheduler, tls, cluster, Limits(time_limit, memory_limit), dashboard)


resource_options = gathered(
    "resources",
    _resources,
    click.option("--workers", type=click.IntRange(1, 4096), help="Local workers.  [default: one per core]"),
    click.option(
        "--pool",
        type=click.Choice(list(POOLS)),
        help=f"What to run on here: {', '.join(pool.words for pool in POOLS.values())}.  "
        f"[default: {DEFAULT_POOL}; serial if small]",
    ),
    click.option(
        "--scheduler", metavar="ADDRESS", help="Use the Dask scheduler at this address, e.g. tcp://host:8786."
    ),
    click.option("--tls-ca", type=EXISTING, help="For a tls:// scheduler: the authority's certificate."),
    click.option("--tls-cert", type=EXISTING, help="For a tls:// scheduler: our certificate."),
    click.option("--tls-key", type=EXISTING, help="For a tls:// scheduler: our key."),
    click.option("--cluster", type=EXISTING, help="Use the Dask cluster that this TOML or YAML file describes."),
    click.option(
        "--time-limit",
        type=click.FloatRange(0, min_open=True),
        metavar="SECONDS",
        help="A block that takes longer fails.",
    ),
    click.option(
        "--memory-limit",
        metavar="BYTES",
        callback=_bytes,
        help="A block whose local worker needs more fails, e.g. 2GB.  [default: an equal share each]",
    ),
    click.option("--dashboard", is_flag=True, help="Give local workers Dask's dashboard; print its address."),
)
