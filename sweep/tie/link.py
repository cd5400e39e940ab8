"""`tie`: the link of two tables, solved with its clip and every kind of error, as an xarray Dataset; `forecast`: what
further observations would do to it, and which sources to observe; `apply`: a table in the other frame.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from astropy.table import Table
from astropy.units import Unit
from scipy.spatial.transform import Rotation

from linksweep.core.frames import DEGREE, MAS, POLE_LIMIT, Array, LinkError, position, triad
from linksweep.core.tie import forecast as planning, mistakes, problem as solving
from linksweep.core.tie.astrometry import ALL_PAIRS, Astrometry, kinds, named_rows
from linksweep.core.tie.noise import ESTIMATE, Noise, estimated, noises
from linksweep.core.unknowns import PARAMETERS, Harmonics, Objects, SpinByBin, Unknowns, amplitudes, link_unknowns
from linksweep.sweep.contract import SweepError, p_value, refused
from linksweep.sweep.executing.executor import mapped
from linksweep.sweep.executing.pools import ANY_RESOURCES, NO_LIMITS, Limits, Resources
from linksweep.sweep.executing.worker import one_thread
from linksweep.sweep.result import require_free, stored_table, write_at_once
from linksweep.sweep.tables.columns import CORRELATIONS, Columns, unit_of
from linksweep.sweep.tables.options import number
from linksweep.sweep.tables.reader import read_table, write_table
from linksweep.sweep.tie import tables as files
from linksweep.sweep.tie.options import FORECAST, SIGNS, TABLE, TIE, ApplyOptions, ForecastOptions, Options, listed
from linksweep.sweep.tie.setup import DECLARED, FROM_ROWS, Setup, in_row_groups, parse_bins, set_up, set_up_row_groups
from linksweep.sweep.tie.tables import QUANTITIES, UNITS, astrometric_table, built_in

# The experiment whose code the workers must have.
EXPERIMENT = "linksweep.sweep.tie.experiment:tie"

ERRORS = ("formal", "scaled", "jackknife", "cells", "bootstrap", "sandwich")

# How often noise is estimated from what a clip keeps with it.
ROUNDS = 20

# A chi2 that is lower by so much with the opposite sign of what is known is no chance.
WORSE = 10.0

# The rows of larger tables are not included in a result.
ROWS_KEPT = 100_000

# If there are too many sources to keep the sums of each, so many are examined for a large share.
HEAVIEST = 100

# Power of degree 1 of a rotation or a glide is this times the square of its length (Mignard & Klioner 2012).
VECTOR_POWER = 8.0 * np.pi / 3.0

# The field whose degree 1 a block is.
FIELD_OF = {"orientation": "position toroidal", "position_glide": "position spheroidal"}
FIELD_OF |= {"spin": "motion toroidal", "glide": "motion spheroidal"}
FIELDS = tuple(FIELD_OF.values())


@dataclass(frozen=True)
class Link:
    """A solved link: its setup, the clip and its solution, the covariances by kind of error, and the influence of each
    source (None where there are too many).  ``discrepancy`` is None where it was not asked for.  The first note is what
    chi2 says of the tables, if anything.  ``noise`` is what was estimated, and is in the errors of the setup.
    """

    setup: Setup
    clip: str
    clipped: solving.Clipped
    covariances: dict[str, Array]
    samples: dict[str, float]
    influence: solving.Influence | None
    discrepancy: Array | None
    count: Any
    misfit: mistakes.Misfit
    notes: tuple[str, ...]
    noise: Noise | None = None

    @property
    def solution(self) -> solving.Solution:
        """The solution of the sources that were kept."""
        return self.clipped.solution


def solve_link(setup: Setup, asked: Options, sources: solving.Sources | None = None, per_source: bool = True) -> Link:
    """Return the solution of a setup with the clip and the errors of the options; raises SweepError if there is none.

    ``sources`` are those of a table that is read by row groups; without ``per_source`` it is not read again for values
    of single sources.
    """
    errors = listed(asked.errors)
    if not errors or any(name not in ERRORS for name in errors):
        raise SweepError(f"errors {', '.join(errors)!r}: must be among {', '.join(ERRORS)}")
    unknowns, effect, noise = setup.problem.unknowns, None, None
    try:
        with one_thread():  # products of blocks are small
            how = solving.parse_clip(asked.clip)
            if sources is None:
                sources = solving.sources_of(setup.problem)
            result = solving.clipped(how, sources)
            doubt, further = _misfit(setup, sources, result), list[str]()
            if any(ESTIMATE in sizes.values() for sizes in setup.jitter.values()):
                setup, sources, result, noise, further = _with_noise(setup, how)
            covariances, samples, notes = _covariances(sources, result, asked, noise)
            squares = sources.discrepancies(result.solution.estimate) if per_source else None
            if isinstance(sources, solving.KeptSources):
                effect = solving.influence(sources.sums, result.solution, unknowns, result.factors)
                places, share = np.arange(len(effect.share)), effect.share
            else:
                places, sums = sources.heaviest(HEAVIEST)
                share = solving.shares(sums, result.solution, unknowns) * result.factors[places, None]
            if setup.epochs is not None and setup.epochs.doubt.text:
                doubt = setup.epochs.doubt
            notes += _of_known(setup, sources, result)
    except ValueError as error:  # LinkError is one
        said = [str(error)]
        if isinstance(error, LinkError):  # which the kinds of rows, or what is not used of the tables, may explain
            said += [f"rows are of the kind {', '.join(np.unique(kinds(setup.problem.rows)))}", *setup.notes]
        raise SweepError("; ".join(said)) from error
    for block, part in zip(unknowns.names, share.T, strict=True):
        if large := sorted(np.flatnonzero(part > solving.LARGE_SHARE), key=part.__getitem__, reverse=True):
            named = ", ".join(f"{setup.names[places[k]]} ({100.0 * part[k]:.0f} %)" for k in large)
            notes.append(f"more than {100 * solving.LARGE_SHARE:.0f} % of the weight in {block}: {named}")
    odd = [note for note in setup.notes if mistakes.WHEN_NONE in note] if doubt.text else []
    doubt = doubt._replace(text=" ".join([*odd, doubt.text]))
    notes = [*filter(None, [doubt.text]), *(n for n in setup.notes if n not in odd), *further, *result.notes, *notes]
    of_sources = effect, squares, sources.count
    return Link(setup, str(how), result, covariances, samples, *of_sources, doubt, tuple(notes), noise)


def _with_noise(setup: Setup, how: solving.Clip) -> tuple[Setup, solving.Sources, solving.Clipped, Noise, list[str]]:
    """Return the setup with the estimated noise in its errors, the solution with it, and notes.

    The noise is that of the sources that the clip keeps when the noise is in the errors.
    """
    problem = setup.problem
    if problem.weights != "covariance":
        raise SweepError(f"jitter estimate is for weights by covariance, not {problem.weights}")
    kept, notes = np.ones(len(problem.satellite), dtype=bool), []
    for _ in range(ROUNDS):
        part = problem.only(np.flatnonzero(kept))
        noise = estimated(part, noises(part, setup.jitter))
        noisy = noise.added_to(problem, setup.jitter)
        sources = solving.sources_of(noisy)
        result = solving.clipped(how, sources)
        if np.array_equal(kept, result.factors > 0.0):
            break
        kept = result.factors > 0.0
    else:
        notes.append(f"the clip with the estimated noise still changed after {ROUNDS} rounds")
    if noise.left_out:
        left_out = ", ".join(noise.left_out)
        notes.append(f"noise of {left_out} cannot be told from that of the rest, and is included there")
    return replace(setup, problem=noisy), sources, result, noise, notes


def _misfit(setup: Setup, sources: solving.Sources, result: solving.Clipped) -> mistakes.Misfit:
    """Return what chi2 says of the sources that are kept, with the best weights; of all if the clip keeps fewer than
    half of them.
    """
    factors, solved, problem = result.factors, result.solution, setup.problem
    # the problem of a table that is read in row groups has no values
    if in_groups := isinstance(sources, solving.StreamedSources) and not np.any(problem.satellite.present):
        if mistakes.DEFICIT <= solved.scale**2 <= mistakes.GOOD:
            return mistakes.Misfit(solved.scale**2)  # a row group is read again only if something is wrong
        problem = sources.problems[0]()
    few = np.count_nonzero(factors) < 0.5 * len(factors)
    if problem.weights != "covariance" or few:
        factors = np.ones(len(factors), dtype=bool) if few else factors
        problem = replace(problem, weights="covariance")
        solved = solved if in_groups else solving.sources_of(problem).solve(factors)
    kept = np.flatnonzero(factors[: len(problem.satellite)] > 0.0)
    return mistakes.misfit(problem, kept, solved, setup.names)


def _of_known(setup: Setup, sources: solving.Sources, result: solving.Clipped) -> list[str]:
    """Return a note on chi2 with what is known, without it and with the opposite sign; none for tables in groups."""
    if setup.problem.known is None or not isinstance(sources, solving.KeptSources):
        return []
    blocks, values = setup.problem.known
    trials = (replace(setup.problem, known=(blocks, factor * values)) for factor in (0.0, -1.0))
    without, opposite = (solving.sources_of(trial).solve(result.factors).squares for trial in trials)
    question = ": is its sign right?" if opposite + WORSE < result.solution.squares else ""
    said = f"chi2 is {result.solution.squares:.6g} with what is known subtracted, {without:.6g} without, {opposite:.6g}"
    return [f"{said} with the opposite sign{question}"]


def _covariances(
    sources: solving.Sources, result: solving.Clipped, asked: Options, noise: Noise | None
) -> tuple[dict[str, Array], dict[str, float], list[str]]:
    """Return the covariance of each kind of error, the main one first, the number of sources or cells whose scatter it
    is (inf for none), and notes.
    """
    solved, notes, sums = result.solution, [], sources.sums
    if sums is not None:
        used = result.factors > 0.0
        sums, factors = sums.taken(used), result.factors[used]
        sums = sums if np.all(factors == 1.0) else sums.scaled(factors)
    covariances = {} if noise is None else {"estimated": noise.covariance(solved)}
    samples = dict.fromkeys(covariances, np.inf)
    for kind in dict.fromkeys([*listed(asked.errors), "formal", "scaled"]):
        groups = sums if kind != "cells" and sums is not None else sources.cell_sums(result.factors)
        if sums is None and kind in ("jackknife", "bootstrap", "sandwich"):
            notes.append(f"{kind} errors are those of {len(groups)} cells of the sky: there are too many sources")
        if kind in ("formal", "scaled"):
            one = solved.covariance * (1.0 if kind == "formal" else solved.scale**2)
        elif kind in ("jackknife", "cells"):
            one = solving.jackknife(groups, solved.normal, solved.normal @ solved.estimate)
        elif kind == "sandwich":
            one = solving.sandwich(groups, solved)
        else:
            one, drawn = solving.bootstrap(groups, asked.resamples, np.random.default_rng(asked.seed))
            if failed := np.count_nonzero(np.isnan(drawn[:, 0])):
                notes.append(f"{failed} of {asked.resamples} resamples did not determine the unknowns")
        if not np.all(np.isfinite(one)):
            why = "there are no degrees of freedom" if kind == "scaled" else "some unknowns depend on a single source"
            notes.append(f"there are no {kind} errors: {why}")
        covariances[kind] = one
        samples[kind] = np.inf if kind in ("formal", "scaled") else float(np.count_nonzero(groups.count > 0))
    return covariances, samples, notes


def spectrum(unknowns: Unknowns, estimate: Array, covariance: Array, **about: float) -> Array:
    """Return of each of `FIELDS` and each degree the power (mas^2 or mas^2/yr^2), its mean for noise alone, c'V^-1 c,
    which for noise alone is a chi2 of 2 l + 1 degrees of freedom or what `p_value` makes of it by what is known
    ``about`` the covariance, and the probability that noise is as significant; shape (4, fields, degrees), NaN for what
    is not among the unknowns.  Rotations and glides are of degree 1; there is no degree without harmonics.
    """
    harmonics = [block for block in unknowns.blocks if isinstance(block, Harmonics)]
    highest = max((degree for block in harmonics for _, degree in block.parts), default=0)
    powers = np.full((4, len(FIELDS), highest), np.nan)
    for block in unknowns.blocks if harmonics else ():
        start, parts = unknowns.part(block.name).start, list[tuple[str, int, Array]]()
        if isinstance(block, Harmonics):  # order 0, then both parts of each other order
            names = {"t": "toroidal", "s": "spheroidal"}
            field = "motion" if block.rate else "position"
            parts = [(f"{field} {names[kind]}", n, np.array([1.0, *[2.0] * (2 * n)])) for kind, n in block.parts]
        elif block.name in FIELD_OF and len(block.labels) == 3:
            parts = [(FIELD_OF[block.name], 1, np.full(3, VECTOR_POWER))]
        for field, degree, weights in parts:
            piece = slice(start, start + len(weights))
            start, x, v = piece.stop, estimate[piece], covariance[piece, piece]
            chi2 = float(x @ np.linalg.solve(v, x)) if np.any(v) else np.nan  # a table linked to itself has errors of 0
            power = weights @ x**2, weights @ np.diag(v), chi2, p_value(chi2, 2 * degree + 1, **about)
            powers[:, FIELDS.index(field), degree - 1] = power
    return powers


# ---- from tables to a dataset


class MisfitError(SweepError):
    """Tables whose chi2 is absurd; ``link`` is the dataset that they give all the same."""

    def __init__(self, link: xr.Dataset) -> None:
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
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    limits: Limits = NO_LIMITS,
    resources: Resources | None = None,
    per_source: bool = True,
    **options: Any,
) -> xr.Dataset:
    """Solve for the link of two tables, reference - satellite.

    A table may be a file in any format that `sweep tie` reads, or the name of a built-in one: icrf2, icrf3, psrpi,
    psrpi-de200, timing-de200.

    Args:
        satellite: the table with the five astrometric parameters, in the satellite's frame.
        reference: the table with measurements of the same objects, or "zero-motion" for quasars.
        unknowns: blocks like "orientation,spin,glide,parallax,vsh_motion:3"; by default those of orientation and spin
            that the tables determine.
        workers: the number of local worker processes, for millions of quasars in Parquet; none by default.
        scheduler: the address of a Dask scheduler whose workers are used; they read the same file.
        cluster: a file that describes a Dask cluster to start and use instead.
        limits: the time and memory that one row group may take on a worker.
        resources: all of these as one.
        per_source: whether the dataset has the values of single sources and rows; without them the memory for a
            Parquet table of millions of quasars hardly grows with their number.
        options: those of `sweep tie`, under the names of `sweep.tie.options.Options`: ``clip``, ``errors``, ``degree``,
            ``where`` and so on.  Options that the command may be given several times are lists or mappings here:
            ``columns={"reference:parallax": "plx"}``, ``missions={"hipparcos": "hip2.fits"}``,
            ``jitter={"position": (0.2, 0.0)}``, ``bins=("phot_g_mean_mag", [6, 8, 10])``.

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
    asked = Options.named(TIE, {"unknowns": unknowns, **options})
    on = resources or Resources(workers, None, scheduler, cluster=cluster, limits=limits)
    if in_row_groups(satellite, reference, asked):
        if ESTIMATE in asked.jitter:
            raise SweepError("jitter estimate needs a table that is solved as a whole; say how large it is, motion=0.1")
        with mapped(EXPERIMENT, on, logging.getLogger("linksweep").warning) as run:
            setup, sources = set_up_row_groups(satellite, asked, run, per_source)
            link = solve_link(setup, asked, sources, per_source)
    elif on == ANY_RESOURCES:
        link = solve_link(set_up(satellite, reference, asked), asked)
    else:
        large = f"Parquet tables of {FROM_ROWS:,} quasars or more without a reference, missions or where"
        raise SweepError(f"workers are for {large}; others are solved in this process: leave --workers and so on out")
    result = as_dataset(link, asked, per_source)
    if link.misfit.absurd and not asked.accept_misfit:
        raise MisfitError(result)
    return result


# The variables that label others, beside those that are called as their dimension.
COORDINATES = (
    *("unit", "block", "ra", "dec", "row_source_index", "row_source", "row_kind", "row_table", "row_epoch"),
    *("amplitude_unit", "observable_unit", "bin_low", "bin_high", "path_model", "transit_path", "noise_unit"),
)


def as_dataset(link: Link, options: Options, per_source: bool = True) -> xr.Dataset:
    """Return the dataset of a link, in mas and mas/yr and in the sign of ``options``.

    Without ``per_source`` it has no dimensions source and row.
    """
    setup, problem, solved = link.setup, link.setup.problem, link.solution
    unknowns, sign = problem.unknowns, SIGNS[options.sign]
    main = next(iter(link.covariances))
    covariance = np.array(list(link.covariances.values())) / MAS**2
    errors = np.sqrt(np.einsum("ekk->ek", covariance))
    both = ("unknown", "unknown_other")
    variables: dict[str, Any] = {
        **_labels(unknowns),
        "unknown_other": ("unknown_other", list(unknowns.labels)),
        "error_kind": ("error_kind", list(link.covariances)),
        "estimate": ("unknown", sign * solved.estimate / MAS, {"long_name": f"{options.sign}", "sign": options.sign}),
        "error": ("unknown", errors[0], {"kind": main}),
        "errors": (("error_kind", "unknown"), errors),
        "covariance": (both, covariance[0], {"kind": main}),
        "covariances": (("error_kind", *both), covariance),
        "samples": ("error_kind", list(link.samples.values()), {"long_name": "sources or cells of the errors"}),
        "chi2": ((), solved.squares),
        "chi2_expected": ((), solved.expected, {"long_name": "average of chi2 if the errors are right"}),
        "dof": ((), solved.dof),
        "n_sources": ((), int(np.sum((link.clipped.factors > 0) & (link.count > 0)))),
        "n_sources_matched": ((), len(problem.satellite)),
    }
    if per_source:
        variables |= _of_sources(link, sign)
        if len(problem.rows) <= ROWS_KEPT and np.any(problem.rows.present) and np.any(problem.satellite.present):
            variables |= _of_rows(link, sign)
        if setup.epochs is not None:
            variables |= files.described(setup.epochs, problem, solved, link.clipped.factors)
    if (noise := link.noise) is not None:
        variables |= {
            "noise": ("noise", list(noise.size)),
            "noise_unit": ("noise", ["mas/yr" if label.endswith("motion") else "mas" for label in noise.size]),
            "noise_size": ("noise", list(noise.size.values()), {"long_name": "added in quadrature to the errors"}),
            "noise_error": ("noise", list(noise.error.values())),
        }
    variables |= _of_steps(link, sign) | _of_harmonics(link, covariance[0]) | _of_bins(link, errors[0], sign)
    variables |= _of_amplitudes(unknowns, sign * solved.estimate / MAS, covariance)
    attributes = {
        "result": "tie",
        "sign": options.sign,
        "clip": link.clip,
        "weights": problem.weights,
        "matched_by": setup.matched.by,
        "rows_unmatched": np.count_nonzero(setup.matched.place < 0),
        **setup.attributes(),
        "missions": {name: setup.tables[name].path for name in problem.tables[1:]},
        "missions_sha256": {name: setup.tables[name].digest for name in problem.tables[1:]},
        "epochs": {} if setup.epochs is None else setup.epochs.files,
        **{name: str(getattr(options, name) or "none") for name in ("known_spin", "known_orientation", "jitter")},
        "aberration_uas_yr": options.aberration,
        "misfit": link.misfit.text if link.misfit.first else "",
        "notes": list(link.notes),
    } | ({"bin_column": parse_bins(options.bins)[0]} if options.bins else {})
    return xr.Dataset(variables, attrs=attributes).set_coords([name for name in COORDINATES if name in variables])


def _of_sources(link: Link, sign: float) -> dict[str, Any]:
    names, values = link.setup.names, link.setup.problem.satellite.values
    variables: dict[str, Any] = {
        "source": ("source", names if names.dtype.kind == "i" else names.astype(str)),
        "ra": ("source", np.degrees(values[0]) % 360.0, {"units": "deg"}),
        "dec": ("source", np.degrees(values[1]), {"units": "deg"}),
        "discrepancy": ("source", link.discrepancy, {"long_name": "chi2 of the residuals of a source"}),
        "n_observations": ("source", link.count.astype(np.float64)),
        "weight_factor": ("source", link.clipped.factors.astype(np.float64), {"long_name": "1 kept, 0 dropped"}),
    }
    if (effect := link.influence) is not None:
        variables |= {
            "block_name": ("block_name", list(link.setup.problem.unknowns.names)),
            "discrepancy_expected": ("source", effect.expected),
            "estimate_without": (("source", "unknown"), sign * effect.without / MAS, {"long_name": "leave one out"}),
            "cook_distance": ("source", effect.cook),
            "share": (("source", "block_name"), effect.share, {"long_name": "share of the weight"}),
        }
    return variables


def _of_rows(link: Link, sign: float) -> dict[str, Any]:
    problem, names = link.setup.problem, link.setup.names
    satellite, source, rows = problem.satellite, problem.source, problem.rows
    before = problem.differences()
    shift = np.einsum("nik,k->ni", problem.unknowns.matrix(*problem.objects(satellite)), link.solution.estimate)
    after = before.values - np.einsum("rij,rj->ri", before.by_frames, shift[source])
    error = np.sqrt(np.einsum("rii->ri", before.whole(satellite.covariance()[source])))
    normalised, plain = solving.separation(problem)

    def shown(values: Array) -> tuple[tuple[str, str], Array]:
        return ("row", "observable"), np.where(before.present, values / MAS, np.nan)

    return {
        "observable": ("observable", list(PARAMETERS)),
        "observable_unit": ("observable", [UNITS[name] for name in PARAMETERS]),
        "row_source_index": ("row", source),
        "row_source": ("row", names[source].astype(str)),
        "row_kind": ("row", kinds(rows)),
        "row_table": ("row", np.array(problem.tables)[rows.frame]),
        "row_epoch": ("row", rows.epoch, {"units": "yr"}),
        "difference": shown(sign * before.values),
        "residual": shown(sign * after),
        "difference_error": shown(error),
        "normalised_separation": ("source", normalised, {"long_name": "X before the fit"}),
        "separation": ("source", plain / MAS, {"units": "mas"}),
    }


def _of_steps(link: Link, sign: float) -> dict[str, Any]:
    names, clipped = link.setup.names, link.clipped
    if not (steps := clipped.trajectory):
        return {}
    errors = np.array([np.sqrt(np.diag(s.covariance)) * s.scale for s in steps]) / MAS
    return {
        "step_estimate": (("step", "unknown"), sign * np.array([s.estimate for s in steps]) / MAS),
        "step_error": (("step", "unknown"), errors, {"kind": "scaled"}),
        "step_chi2": ("step", np.array([s.squares for s in steps])),
        "step_dof": ("step", np.array([s.dof for s in steps])),
        "step_dropped": ("step", np.array([names[i] if i >= 0 else "" for i in clipped.dropped]).astype(str)),
        "step_chosen": ((), clipped.chosen),
    }


def _of_harmonics(link: Link, main: Array) -> dict[str, Any]:
    kind, samples = next(iter(link.samples.items()))
    about = {"samples": samples, "scaled": link.solution.dof if kind == "scaled" else np.inf}
    powers = spectrum(link.setup.problem.unknowns, link.solution.estimate / MAS, main, **about)
    there = np.isfinite(powers[0])
    if not np.any(there):
        return {}
    fields = sorted(np.flatnonzero(there.any(axis=1)), key=FIELDS.__getitem__)
    degrees = np.flatnonzero(there.any(axis=0))
    names = ("power", "power_noise", "power_chi2", "power_probability")
    labels = {"degree": ("degree", degrees + 1), "field": ("field", [FIELDS[k] for k in fields])}
    table = powers[:, np.array(fields)[:, None], degrees]
    return labels | {name: (("field", "degree"), values) for name, values in zip(names, table, strict=True)}


def _of_amplitudes(unknowns: Unknowns, estimate: Array, covariances: Array) -> dict[str, Any]:
    """Return rotation, glide and quadrupoles of harmonics, whose covariances by kind are those of the unknowns."""
    names, units, rows = list[str](), list[str](), []
    for block in (block for block in unknowns.blocks if isinstance(block, Harmonics)):
        some, matrix = amplitudes(block)
        names, units = names + some, units + ["mas/yr" if block.rate else "mas"] * len(some)
        rows.append(np.zeros((len(some), len(unknowns))))
        rows[-1][:, unknowns.part(block.name)] = matrix
    if not names:
        return {}
    whole = np.concatenate(rows)
    made = whole @ covariances @ whole.T
    return {
        "amplitude_name": ("amplitude_name", names),
        "amplitude_unit": ("amplitude_name", units),
        "amplitude": ("amplitude_name", whole @ estimate),
        "amplitude_errors": (("error_kind", "amplitude_name"), np.sqrt(np.einsum("ekk->ek", made))),
        "amplitude_covariance": (("amplitude_name", "amplitude_name_other"), made[0]),
    }


def _of_bins(link: Link, errors: Array, sign: float) -> dict[str, Any]:
    unknowns = link.setup.problem.unknowns
    block = next((block for block in unknowns.blocks if isinstance(block, SpinByBin)), None)
    if block is None:
        return {}
    both = np.array([sign * link.solution.estimate / MAS, errors])[:, unknowns.part(block.name)]
    spins, spin_errors = both.reshape(2, -1, 3)
    in_bins, unit = ("bin", "component"), {"units": "mas/yr"}
    return {
        "bin": ("bin", [f"[{low:g},{high:g})" for low, high in block.bins]),
        "bin_low": ("bin", [low for low, _ in block.bins]),
        "bin_high": ("bin", [high for _, high in block.bins]),
        "component": ("component", ["x", "y", "z"]),
        "spin_by_bin": (in_bins, spins, unit),
        "spin_by_bin_error": (in_bins, spin_errors, unit),
    }


# ---- a forecast


def forecast(satellite: str | Path, reference: str | Path, unknowns: str | None = None, **options: Any) -> xr.Dataset:
    """Predict the formal errors of a link with further observations, and the sources to observe first.

    Args:
        satellite: the table with the five astrometric parameters, as for `tie`.
        reference: the table with the measurements of the same objects so far.
        unknowns: blocks like "orientation,spin".
        options: those of `sweep forecast`, under the names of `ForecastOptions` and `Options` in `sweep.tie.options`:
            ``add`` (epochs, Julian years, at which a single-epoch position of each source is added), ``error`` (mas, of
            its coordinates), ``release`` (to which the satellite's errors are scaled), ``from_release``, ``number`` (of
            sources to choose), ``goal`` (the blocks for which these are best), ``criterion`` ("A": the trace of their
            covariance, "D": its determinant), ``all_sources``, and those of tables as for `tie`.

    Returns:
        A dataset with ``error`` (stage, unknown) in mas and mas/yr, ``error_with_epoch`` (new_epoch, unknown),
        ``criterion_alone`` and ``rank`` of each source, and the steps of the choice; `plot` draws it.

    Raises:
        SweepError: for bad input, or if the tables do not determine the unknowns.

    Example:
        >>> plan = forecast("psrpi", "psrpi", "orientation,spin", add=[2030], number=2, goal=["spin"])
        >>> plan.stage.values.tolist()
        ['now', 'all observed']
        >>> plan.step_source.values.tolist()
        ['', 'J1537+1155', 'J2354+6155']
    """
    plan = ForecastOptions.named(FORECAST, options, Options)
    asked = Options.named(FORECAST, {"unknowns": unknowns, **options}, ForecastOptions)
    with refused(ValueError, said="add: "):
        add = [DECLARED["epoch"].parse(number(year)) for year in listed(plan.add)]
    if plan.number and not add:
        raise SweepError(f"{plan.number} sources to choose, but no epochs to observe them at")
    if plan.release == TABLE and plan.from_release != TABLE:
        raise SweepError(f"from_release {plan.from_release}, but no release to scale errors to")
    if ESTIMATE in asked.jitter:
        raise SweepError("a forecast uses no measured values: sweep tie --jitter estimate says how large a jitter is")
    setup = set_up(satellite, reference, asked, plan.all_sources)
    problem = setup.problem
    goal = planning.Goal(problem.unknowns, tuple(listed(plan.goal)), plan.criterion)
    with refused(ValueError):
        _ = goal.parts  # raises for an unknown block
        future, old, further = planning.released(problem, plan.release, plan.from_release, asked.epoch is None)

        def observed(*epochs: float) -> solving.NormalSums:
            """Return the sums of each source with new positions at some epochs."""
            return solving.source_sums(setup.with_new_rows(future, epochs, plan.error, asked.positions))

        base = solving.source_sums(future)
        planned = observed(*add) if add else base
        sources, steps = planning.choose(base, planned, plan.number, goal)
        if len(sources) < plan.number:
            further.append(f"only {len(sources)} sources to choose")
        total = base.matrices.sum(axis=0)
        # At the epoch of the others, to which a release moves it: the error of an orientation depends on it.
        stages = {"now": solving.source_sums(replace(problem, epoch=future.epoch)).matrices.sum(axis=0)}
        stages |= {} if plan.release == TABLE else {plan.release: total}
        stages |= {"all observed": planned.matrices.sum(axis=0)} if add else {}
        by_epoch = [observed(epoch).matrices.sum(axis=0) for epoch in add]
    gain = [goal.value(total + one) for one in planned.matrices - base.matrices]
    variables: dict[str, Any] = {
        "error": (("stage", "unknown"), _errors(stages.values())),
        "criterion": ("stage", _scaled(map(goal.value, stages.values()), goal)),
        "criterion_alone": ("source", _scaled(gain, goal), {"long_name": "if this source alone is observed"}),
        "rank": ("source", np.argsort(np.argsort(gain)) + 1),
    }
    coordinates = {"stage": list(stages)} | _labels(problem.unknowns) | {"source": setup.names.astype(str)}
    if add:
        coordinates["new_epoch"] = add
        variables["error_with_epoch"] = (("new_epoch", "unknown"), _errors(by_epoch))
    if sources:
        variables |= {
            "step_source": ("step", np.array(["", *setup.names[sources]]).astype(str)),
            "step_error": (("step", "unknown"), _errors(steps)),
            "step_criterion": ("step", _scaled(map(goal.value, steps), goal)),
        }
    attributes = setup.attributes() | {
        "result": "forecast",
        "epoch": future.epoch,
        "epoch_of_forecast": future.epoch,
        "release": plan.release if old else "",
        "from_release": old,
        "new_error_mas": plan.error,
        "goal": ", ".join(goal.blocks or problem.unknowns.names),
        "criterion": plan.criterion,
        "notes": [*further, *setup.notes],
    }
    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def _labels(unknowns: Unknowns) -> dict[str, Any]:
    """Return the coordinates of unknowns."""
    return {
        "unknown": ("unknown", list(unknowns.labels)),
        "unit": ("unknown", list(unknowns.units)),
        "block": ("unknown", [block.name for block in unknowns.blocks for _ in block.labels]),
    }


def _errors(totals: Iterable[Array]) -> Array:
    """Return the formal errors of some sums in mas and mas/yr; NaN where these do not determine the unknowns."""
    return np.array([np.sqrt(np.diag(solving.covariance_of(matrices))) / MAS for matrices in totals])


def _scaled(values: Iterable[float], goal: planning.Goal) -> Array:
    """Return a criterion in mas instead of rad: the root of the mean variance, or the log determinant."""
    numbers, n = np.array(list(values)), len(goal.parts)
    return np.asarray(np.sqrt(numbers / n) / MAS if goal.criterion == "A" else numbers - 2.0 * n * np.log(MAS))


# ---- a table in the other frame

# The formats that astropy knows by the names of files.
FORMATS = (".csv", ".ecsv", ".fits", ".parquet")

ROTATION = link_unknowns()
OFF_POLE = np.pi / 2.0 - 2.0 * POLE_LIMIT  # beyond which a rotation turns axes by any angle


def apply(
    link: xr.Dataset | str | Path,
    table: str | Path | Table,
    output: str | Path | None = None,
    *,
    inverse: bool = False,
    **options: Any,
) -> Table:
    """Return a table of the satellite's frame in that of the reference, or back.

    Positions and motions are turned by the orientation at the epoch of each row, and motions by the spin, exactly; the
    sign of the link does not matter.  Parallaxes stay.  The covariance of the link is added to that of each row, which
    correlates the rows with each other: nothing in the table says so.

    Args:
        link: what `tie` returned, or the store that `sweep tie -o` wrote.
        table: a table in the satellite's frame: a file in any format of `tie`, the name of a built-in one, or a Table
            of astropy, which is copied.
        output: the file to write: .csv, .ecsv, .fits or .parquet.
        inverse: whether the table is in the frame of the reference, and is carried into that of the satellite.
        options: those of `sweep apply`, under the names of `ApplyOptions` in `sweep.tie.options`: ``epoch`` (Julian
            year, of a table without a column of epochs), ``columns``, ``units``, ``without_cos_dec`` and
            ``zero_errors``.  What they do not say is as the link's own table was read, for columns that are there.

    Returns:
        The table with its own columns, in their own units; ``meta["comments"]`` says what was done.

    Raises:
        SweepError: for a link with other unknowns than orientation and spin, a table of another release's epoch,
            columns that cannot hold the result, and a file that exists.

    Example:
        >>> import linksweep
        >>> link = linksweep.tie("psrpi-de200", "timing-de200", "orientation")
        >>> moved = apply(link, "psrpi-de200")
        >>> [round(float(dec), 7) for dec in moved["dec"][:2]]
        [53.1172503, 53.1172503]
    """
    asked = ApplyOptions.named("apply", options)
    output = None if output is None else Path(output)
    if output is not None:
        require_free(output)
        if output.suffix not in FORMATS:
            raise SweepError(f"a table is written as {', '.join(FORMATS)}", str(output))
    if isinstance(link, (str, Path)):
        if (stored := stored_table(link)) is None or stored.kind != "tie":
            raise SweepError("is no link of two tables, which sweep tie -o writes", str(link))
        link = stored.dataset
    if isinstance(table, Table):
        raw, where, digest = Table(table), "the table", ""  # without quantities
    else:
        path = built_in(Path(table))
        raw, where, digest = read_table(path), str(path), files.digest_of(path)
    how = files.as_read(link.attrs, raw, digest, asked)
    whole = astrometric_table(raw, where, digest, how)
    whole.require_positions()
    stars = whole.astrometry
    notes = [*_notes(link, stars, inverse, where), *(note for note in whole.notes if "unit" in note)]
    read = Columns(raw, where, how.columns, how.units, QUANTITIES)
    if files.hipparcos_elements(read) is not None:
        raise SweepError("has correlations as elements U1 to U15: write columns like ra_dec_corr instead", where)
    new = _moved(stars, link, inverse)
    put = _put(read, new, how.pmra_cos_dec, output is not None and output.suffix == ".csv")
    lost = [name for name in CORRELATIONS if not read.has(name) and np.any(np.nan_to_num(new.get(name, 0.0)))]
    if lost and not read.has("corr_vec"):
        notes.append(f"the table has no {', '.join(lost)}: these correlations, which the link adds, are lost")
    notes.append(f"columns that were changed: {', '.join(put)}")
    said = [f"{key}={value}" for key, value in [*how.columns.items(), *how.units.items()]]
    if said := said + ["pmra without cos(dec)"] * (how.pmra_cos_dec is False):
        notes.append(f"the table was read with {', '.join(said)}")
    raw.meta["comments"] = [*raw.meta.get("comments", []), *notes]
    if output is not None:
        errors = ValueError, TypeError, AttributeError, NotImplementedError  # each format has its own
        with refused(*errors, said=f"{output.suffix} cannot hold the table: ", where=output, more="; write .ecsv"):
            write_at_once(output, lambda path: write_table(raw, path))  # it warns of long names in a FITS header
    return raw


def _notes(link: xr.Dataset, stars: Astrometry, inverse: bool, path: str) -> list[str]:
    """Return what is to be said of a link and a table; raises SweepError where one cannot be applied to the other."""
    blocks = dict.fromkeys(map(str, link["block"].values.tolist()))
    applied = [name for name in blocks if name.partition(":")[0] not in link.attrs["missions"]]
    if further := [name for name in applied if name not in ROTATION.names]:
        raise SweepError(f"the link has {', '.join(further)} too; only orientation and spin are applied: solve again")
    known = [name for name in ("known_spin", "known_orientation") if link.attrs.get(name, "none") != "none"]
    if "bin" in link.dims or known:
        raise SweepError(f"the link is beside {' and '.join(known) or 'spins by bins'}: solve for orientation and spin")
    low, high = link.attrs.get("satellite_epochs", [link.attrs["epoch"]] * 2)
    other = np.flatnonzero((stars.epoch < low - planning.SAME_EPOCH) | (stars.epoch > high + planning.SAME_EPOCH))
    if len(other) and not inverse:
        epochs = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        said = f"epoch {stars.epoch[other[0]]:g} in {named_rows(other)}, and the link is of {epochs}"
        raise SweepError(f"{said}: the frame of another release is another one", path)
    there = np.isfinite(stars.values)
    if len(half := np.flatnonzero(there[3] != there[4])):
        raise SweepError(f"only one coordinate of the motion in {named_rows(half)}", path)
    frames = "reference to the satellite" if inverse else "satellite to the reference"
    notes = [f"carried from the frame of the {frames} by {' and '.join(applied)}, with the link's covariance added"]
    notes += [f"the link has no {name}, which is not changed" for name in ROTATION.names if name not in applied]
    return [*notes, "rows are correlated with each other by the link, whose covariance they share"]


def _moved(stars: Astrometry, link: xr.Dataset, inverse: bool) -> dict[str, Array]:
    """Return values, errors and correlations of stars in the other frame, in rad and rad/yr."""
    at = [link["unknown"].values.tolist().index(label) if label in link["unknown"] else -1 for label in ROTATION.labels]
    known = np.array(at) >= 0
    x = np.where(known, link["estimate"].values[at], 0.0) * SIGNS[link.attrs["sign"]] * MAS
    covariance = np.where(known[:, None] & known, link["covariance"].values[np.ix_(at, at)], 0.0) * MAS**2
    years = np.nan_to_num(stars.epoch - link.attrs["epoch"]) * known[0]
    turn = Rotation.from_rotvec(x[:3] + years[:, None] * x[3:])
    turn = turn.inv() if inverse else turn
    old = triad(*stars.values[:2])
    motion = np.nan_to_num(stars.values[3:])
    velocity, spin = (old.p * motion[0] + old.q * motion[1]).T, np.broadcast_to(x[3:], (len(stars), 3))
    r = turn.apply(old.r.T)
    velocity = turn.apply(velocity - np.cross(spin, old.r.T)) if inverse else turn.apply(velocity) + np.cross(spin, r)
    ra, dec = position(r.T)
    axes = triad(ra, dec)[:2]
    values = stars.values.copy()
    # in -180..180 deg where the table is
    values[:2] = (ra + np.pi) % (2.0 * np.pi) - np.pi if np.any(values[0] < 0.0) else ra, dec
    values[3:] = np.where(np.isfinite(values[3:]), [np.sum(axis * velocity.T, axis=0) for axis in axes], np.nan)
    off_pole = np.clip(dec, -OFF_POLE, OFF_POLE)
    effect = ROTATION.matrix(Objects(ra, off_pole, *np.nan_to_num(values[3:])), years) * stars.present.T[..., None]
    # the axes of errors turn too, by so little (1e-7) that their covariance does not change
    whole = stars.covariance()
    whole[:, :5, :5] += effect @ covariance @ effect.swapaxes(1, 2)
    whole[:, [0, 1], [0, 1]] -= stars.shared[:, None] ** 2  # the part of a calibrator has a column of its own
    errors = np.sqrt(np.einsum("nii->in", whole))
    errors[errors == 0.0] = np.nan  # there is none, or it is exact
    new = {name: values[i] for i, name in enumerate(PARAMETERS) if name != "parallax"}
    new |= {f"{name}_error": errors[i] for i, name in enumerate(PARAMETERS) if name != "parallax"}
    pairs = [(name, i, j) for name, (i, j) in zip(CORRELATIONS, ALL_PAIRS, strict=False) if j < len(errors)]
    return new | {name: whole[:, i, j] / (errors[i] * errors[j]) for name, i, j in pairs}


def _put(read: Columns, new: dict[str, Array], cos_dec: bool | None, is_csv: bool) -> list[str]:
    """Put quantities into their columns, in the units of these, and return the columns; raises SweepError for those
    that cannot hold them.  ``cos_dec`` says whether pmra has that factor, by default unless it is in units of time.
    """
    put = []
    for quantity, values in new.items():
        if (name := read.name(quantity)) not in read.names or name is None:
            continue
        unit, usual = read.table[name].unit, unit_of(quantity)
        if read.kind(name) not in "fiu":
            read.problems.append(f"column {name!r} is text: write it in {usual} first")
        elif is_csv and unit is not None and usual and Unit(unit) != Unit(usual):
            read.problems.append(f"column {name!r} is in {unit}, which CSV cannot say: write .ecsv")
        else:
            put.append(name)
            scale: Any = read.factor(quantity) * (DEGREE if quantity in ("ra", "dec") else MAS) if usual else 1.0
            if read.lacks_cos_dec(quantity, cos_dec if quantity.startswith("pmra") else None):
                scale = scale * np.cos(new["dec"])
            at = np.isfinite(values)
            read.table[name] = read.table[name].astype(np.float64)
            read.table[name][at] = (values / scale)[at]
    read.finish()
    return [*put, *([files.put_vector(read, new)] if read.has("corr_vec") else [])]
