"""`tie`: the link of two tables as a labelled dataset."""

import logging
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import mapped
from linksweep.sweep.executing.pools import NO_LIMITS, Limits, Resources
from linksweep.sweep.tie.dataset import as_dataset
from linksweep.sweep.tie.options import Options
from linksweep.sweep.tie.row_groups import set_up_row_groups, why_whole
from linksweep.sweep.tie.setup import set_up
from linksweep.sweep.tie.solution import RESAMPLES, Link, solve_link

if TYPE_CHECKING:
    import xarray as xr

EXPERIMENT = "linksweep.sweep.tie.experiment:tie"
"""The experiment whose code the workers must have."""


class MisfitError(SweepError):
    """Tables whose chi2 is absurd; ``link`` is the dataset that they give all the same."""

    def __init__(self, link: "xr.Dataset") -> None:
        self.link = link
        super().__init__(self.said("accept_misfit=True"))

    def said(self, option: str) -> str:
        """Return the message, which names the option that accepts the link."""
        return f"{self.link.attrs['misfit']}. Nothing is written; {option} accepts it"


def tie(
    satellite: str | Path,
    reference: str | Path,
    unknowns: str | None = None,
    *,
    clip: str = "none",
    errors: str | Sequence[str] = "scaled",
    resamples: int = RESAMPLES,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    limits: Limits = NO_LIMITS,
    resources: Resources | None = None,
    per_source: bool = True,
    accept_misfit: bool = False,
    **options: Any,
) -> "xr.Dataset":
    """Solve for the link of two tables, reference - satellite.

    A table may be a file in any format that `sweep tie` reads, or the name of a built-in one: icrf2, icrf3, psrpi,
    psrpi-de200, timing-de200.

    Args:
        satellite: the table with the five astrometric parameters, in the satellite's frame.
        reference: the table with measurements of the same objects, or "zero-motion" for quasars.
        unknowns: blocks like "orientation,spin,glide,parallax,vsh_motion:3"; by default those of orientation and spin
            that the tables determine.
        clip: "none", "rayleigh", "median:5", "discrepancy", "discrepancy:3" or "huber:2".
        errors: one or more of formal, scaled, jackknife, cells, bootstrap and sandwich; the first is the main one.
        resamples: the number of resamples of the bootstrap.
        seed: the seed of the bootstrap.
        workers: the number of local worker processes, for millions of quasars in Parquet; none by default.
        scheduler: the address of a Dask scheduler whose workers are used; they read the same file.
        cluster: a file that describes a Dask cluster to start and use instead.
        limits: the time and memory that one row group may take on a worker.
        resources: all of these as one.
        per_source: whether the dataset has the values of single sources and rows; without them the memory for a
            Parquet table of millions of quasars hardly grows with their number.
        accept_misfit: whether a link is given although chi2 is more than 1000 times its expectation.
        options: further options of `sweep tie`: ``degree``, ``bins`` (a column and edges), ``by``, ``epoch``,
            ``weights``, ``known_spin``, ``jitter`` (kind of row to (mas, mas/yr)), ``sign``, ``aberration``,
            ``corrections``, ``missions`` (further tables by name, each with an orientation and a spin of its own),
            ``satellite_options``, ``reference_options`` and ``mission_options``
            (`sweep.tie.column_names.TableOptions`).

    Returns:
        A dataset with ``estimate``, ``error``, ``errors`` (error_kind, unknown) and ``covariance`` in mas and mas/yr,
        the residuals of the rows, the influence of each source and the steps of the clip; `plot` draws it.

    Raises:
        SweepError: for bad input, with the rows or unknowns that are wrong; and where chi2 is more than 1000 times its
            expectation, with the likely cause.

    Example:
        >>> link = tie("psrpi-de200", "timing-de200", "orientation", errors="scaled,jackknife")
        >>> link.estimate.values.round(1).tolist()
        [-0.9, -13.1, -12.2]
        >>> link.attrs["sign"], link.unit.values.tolist()
        ('reference-satellite', ['mas', 'mas', 'mas'])
    """
    known = {field.name for field in fields(Options)}
    if unknown := sorted(set(options) - known):
        raise SweepError(f"no option {', '.join(unknown)}; there are {', '.join(sorted(known))}")
    asked = Options(unknowns=unknowns, **options)
    kinds = [name.strip() for name in errors.split(",")] if isinstance(errors, str) else list(errors)
    on = resources or Resources(
        workers, None, scheduler, cluster=None if cluster is None else Path(cluster), limits=limits
    )
    if (why := why_whole(satellite, reference, asked)) is None:
        with mapped(EXPERIMENT, on, logging.getLogger("linksweep").warning) as run:
            setup, table = set_up_row_groups(satellite, asked, run, per_source)
            link = solve_link(setup, clip, kinds, resamples, seed, table, per_source)
            return _accepted(link, as_dataset(link, asked, per_source), accept_misfit)
    if not on.none_requested:
        raise SweepError(
            f"workers are for tables that are read by row groups, and these are solved at once in this process: {why}; "
            "leave --workers, --scheduler and the like out"
        )
    link = solve_link(set_up(satellite, reference, asked), clip, kinds, resamples, seed)
    return _accepted(link, as_dataset(link, asked, per_source), accept_misfit)


def _accepted(link: Link, result: "xr.Dataset", accept_misfit: bool) -> "xr.Dataset":
    if link.misfit.absurd and not accept_misfit:
        raise MisfitError(result)
    return result
