"""`tie`: the link of two tables as an xarray Dataset, every number with its dimension, unit and sign."""

import logging
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.core.frames import MAS, Array
from linksweep.core.tie.astrometry import differences, kinds
from linksweep.core.tie.clips import separation
from linksweep.core.unknowns import PARAMETERS, SpinByBin
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import mapped
from linksweep.sweep.executing.pools import NO_LIMITS, Limits, Resources
from linksweep.sweep.tie.options import SIGNS, Options
from linksweep.sweep.tie.row_groups import set_up_row_groups, why_whole
from linksweep.sweep.tie.setup import set_up
from linksweep.sweep.tie.solution import RESAMPLES, Link, solve_link, spectrum

if TYPE_CHECKING:
    import xarray as xr

EXPERIMENT = "linksweep.sweep.tie.experiment:tie"
"""The experiment whose code the workers must have."""

ROWS_KEPT = 100_000
"""The rows of larger tables are not included in a result."""


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
            (`sweep.tie.options.TableOptions`).

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


def as_dataset(link: Link, options: Options, per_source: bool = True) -> "xr.Dataset":
    """Return the dataset of a link, in mas and mas/yr and in the sign of ``options``.

    Without ``per_source`` it has no dimensions source and row.
    """
    import xarray as xr

    setup, problem, solution = link.setup, link.setup.problem, link.solution
    unknowns, sign = problem.unknowns, SIGNS[options.sign]
    order = [link.main, *(kind for kind in link.covariances if kind != link.main)]
    covariance = np.array([link.covariances[kind] for kind in order]) / MAS**2
    errors = np.sqrt(np.einsum("ekk->ek", covariance))
    with np.errstate(invalid="ignore", divide="ignore"):  # tables without any discrepancy have scaled errors of 0
        correlation = covariance[0] / np.outer(errors[0], errors[0])
    variables: dict[str, Any] = {
        "estimate": ("unknown", sign * solution.estimate / MAS, {"long_name": f"{options.sign}", "sign": options.sign}),
        "error": ("unknown", errors[0], {"kind": link.main}),
        "errors": (("error_kind", "unknown"), errors),
        "covariance": (("unknown", "unknown_other"), covariance[0], {"kind": link.main}),
        "covariances": (("error_kind", "unknown", "unknown_other"), covariance),
        "correlation": (("unknown", "unknown_other"), correlation),
        "chi2": ((), solution.squares),
        "chi2_expected": ((), solution.expected, {"long_name": "average of chi2 if the errors are right"}),
        "dof": ((), solution.dof),
        "n_sources": ((), int(np.sum((link.clipped.factors > 0) & (link.count > 0)))),
        "n_sources_matched": ((), len(problem.satellite)),
    }
    coordinates: dict[str, Any] = {
        "unknown": list(unknowns.labels),
        "unknown_other": list(unknowns.labels),
        "unit": ("unknown", list(unknowns.units)),
        "block": ("unknown", [b.name for b in unknowns.blocks for _ in b.labels]),
        "error_kind": order,
    }
    if per_source:
        _add_sources(link, variables, coordinates, sign)
        if len(problem.rows) <= ROWS_KEPT and np.any(problem.rows.present) and np.any(problem.satellite.present):
            _add_rows(link, variables, coordinates, sign)
    _add_steps(link, variables, sign)
    _add_spectrum(link, covariance[0], variables, coordinates)
    _add_bins(link, errors[0], variables, coordinates, sign)
    attributes = {
        "result": "tie",
        "sign": options.sign,
        "epoch": problem.epoch,
        "clip": link.clip,
        "weights": problem.weights,
        "matched_by": setup.matched.by,
        "rows_unmatched": len(setup.matched.unmatched),
        "satellite": setup.satellite.path,
        "satellite_sha256": setup.satellite.digest,
        "reference": setup.reference.path,
        "reference_sha256": setup.reference.digest,
        "missions": {name: table.path for name, table in setup.missions.items()},
        "missions_sha256": {name: table.digest for name, table in setup.missions.items()},
        "known_spin": str(options.known_spin) if options.known_spin is not None else "none",
        "aberration_uas_yr": options.aberration,
        "jitter": ", ".join(f"{k}={p:g}:{m:g}" for k, (p, m) in options.jitter.items()) or "none",
        "misfit": link.misfit.text if link.misfit.first else "",
        "notes": list(link.notes),
    } | ({} if options.bins is None else {"bin_column": options.bins[0]})
    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def _add_sources(link: Link, variables: dict[str, Any], coordinates: dict[str, Any], sign: float) -> None:
    names, values = link.setup.names, link.setup.problem.satellite.values
    coordinates |= {
        "source": names if names.dtype.kind == "i" else names.astype(str),
        "ra": ("source", np.degrees(values[0]) % 360.0, {"units": "deg"}),
        "dec": ("source", np.degrees(values[1]), {"units": "deg"}),
    }
    variables |= {
        "discrepancy": ("source", link.discrepancy, {"long_name": "chi2 of the residuals of a source"}),
        "n_observations": ("source", link.count.astype(np.float64)),
        "weight_factor": ("source", link.clipped.factors.astype(np.float64), {"long_name": "1 kept, 0 dropped"}),
    }
    if (effect := link.influence) is not None:
        coordinates["block_name"] = list(link.setup.problem.unknowns.names)
        variables |= {
            "discrepancy_expected": ("source", effect.expected),
            "estimate_without": (("source", "unknown"), sign * effect.without / MAS, {"long_name": "leave one out"}),
            "cook_distance": ("source", effect.cook),
            "share": (("source", "block_name"), effect.share, {"long_name": "share of the weight"}),
        }


def _add_rows(link: Link, variables: dict[str, Any], coordinates: dict[str, Any], sign: float) -> None:
    problem, names = link.setup.problem, link.setup.names
    satellite, source, rows = problem.satellite, problem.source, problem.rows
    before = differences(satellite, rows, source, problem.taken_out(satellite), problem.unknowns.frames)
    shift = np.einsum("nik,k->ni", problem.unknowns.matrix(*problem.objects(satellite)), link.solution.estimate)
    after = before.values - np.einsum("rij,rj->ri", before.by_frames, shift[source])
    covariance = satellite.covariance()[source]
    whole = before.covariance + before.partials @ covariance @ before.partials.swapaxes(1, 2)
    error = np.sqrt(np.einsum("rii->ri", whole))
    normalised, plain = separation(problem)
    tables = np.array(["reference", *link.setup.missions])
    coordinates |= {
        "observable": list(PARAMETERS),
        "row_source_index": ("row", source),
        "row_source": ("row", names[source].astype(str)),
        "row_kind": ("row", kinds(rows)),
        "row_table": ("row", tables[np.zeros_like(source) if rows.frame is None else rows.frame]),
        "row_epoch": ("row", rows.epoch, {"units": "yr"}),
        "observable_unit": ("observable", ["mas", "mas", "mas", "mas/yr", "mas/yr"]),
    }
    for name, values in (("difference", sign * before.values), ("residual", sign * after), ("difference_error", error)):
        variables[name] = (("row", "observable"), np.where(before.present, values / MAS, np.nan))
    variables |= {
        "normalised_separation": ("source", normalised, {"long_name": "X before the fit"}),
        "separation": ("source", plain / MAS, {"units": "mas"}),
    }


def _add_steps(link: Link, variables: dict[str, Any], sign: float) -> None:
    names, clipped = link.setup.names, link.clipped
    if not (steps := clipped.trajectory):
        return
    errors = np.array([np.sqrt(np.diag(s.covariance)) * s.scale for s in steps]) / MAS
    variables |= {
        "step_estimate": (("step", "unknown"), sign * np.array([s.estimate for s in steps]) / MAS),
        "step_error": (("step", "unknown"), errors, {"kind": "scaled"}),
        "step_chi2": ("step", np.array([s.squares for s in steps])),
        "step_dof": ("step", np.array([s.dof for s in steps])),
        "step_dropped": ("step", np.array([names[i] if i >= 0 else "" for i in clipped.dropped]).astype(str)),
        "step_chosen": ((), clipped.chosen),
    }


def _add_spectrum(link: Link, main: Array, variables: dict[str, Any], coordinates: dict[str, Any]) -> None:
    powers = spectrum(link.setup.problem.unknowns, link.solution.estimate / MAS, main)
    if not powers:
        return
    degrees, fields = (sorted({getattr(power, name) for power in powers}) for name in ("degree", "field"))
    table = np.full((4, len(fields), len(degrees)), np.nan)
    for field, degree, *numbers in powers:
        table[:, fields.index(field), degrees.index(degree)] = numbers
    coordinates |= {"degree": degrees, "field": fields}
    names = ("power", "power_noise", "power_chi2", "power_probability")
    variables |= {name: (("field", "degree"), values) for name, values in zip(names, table, strict=True)}


def _add_bins(link: Link, errors: Array, variables: dict[str, Any], coordinates: dict[str, Any], sign: float) -> None:
    unknowns = link.setup.problem.unknowns
    for block in (block for block in unknowns.blocks if isinstance(block, SpinByBin)):
        part = unknowns.part(block.name)
        coordinates |= {
            "bin": [f"[{low:g},{high:g})" for low, high in block.bins],
            "bin_low": ("bin", [low for low, _ in block.bins]),
            "bin_high": ("bin", [high for _, high in block.bins]),
            "component": ["x", "y", "z"],
        }
        for name, values in (("spin_by_bin", sign * link.solution.estimate / MAS), ("spin_by_bin_error", errors)):
            variables[name] = (("bin", "component"), values[part].reshape(-1, 3), {"units": "mas/yr"})
