"""Five-parameter astrometry of many objects as measured, where anything but the position may be missing; its exact
motion between epochs; and reference rows minus the satellite's parameters at the rows' epochs.

Differences are reference - satellite everywhere; angles are radians and proper motions rad/yr.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from typing import Any

import erfa
import numpy as np

from linksweep.core.frames import ARCSEC, Array, Flags, Indices, Texts, triad

# The two parameters of each correlation: those of the five in the order of the Gaia archive, then those with
# accelerations, and with a semi-axis.
ALL_PAIRS = tuple(sorted(combinations(range(10), 2), key=lambda pair: (pair[1] >= 5) + (pair[1] >= 9)))
PAIRS = ALL_PAIRS[:10]
FIRST, SECOND = np.array(ALL_PAIRS).T

# What the path of a star may have beside them: acceleration (rad/yr2), its derivative (rad/yr3) at the epoch, and the
# semi-axis of an orbit (rad) whose other elements are known.
FURTHER = ("accel_ra", "accel_dec", "deriv_accel_ra", "deriv_accel_dec", "semi_major_axis")

J2000 = 2451545.0
DAYS_PER_YEAR = 365.25
KEPT_EPOCHS = 10_000
# Steps of Newton's method for Kepler's equation, from the start of Danby 1987 (Celest. Mech. 40, 303).
KEPLER = 12
# Half of the time over which DR3 averages accelerated motions, in years.  Source: Gaia DR3 documentation, Eq. 7.5.
HALF_SPAN = 517.5 / DAYS_PER_YEAR


@dataclass(frozen=True)
class Astrometry:
    """N sets of (ra, dec, parallax, pmra, pmdec) with errors; NaN is a missing value.

    ``values`` and ``errors`` (5, N) in rad and rad/yr (pmra is mu_alpha*, the error of ra that of alpha*);
    ``correlations`` (10, N) in the order of `PAIRS`, more with further parameters, or None for none; ``epoch`` (N,) in
    Julian years, NaN where the position has none (that of an extragalactic source holds at any epoch);
    ``radial_velocity`` (N,) in km/s, NaN where unknown; ``names`` (N,); ``columns`` are further numbers by name;
    ``apparent`` (N,) marks positions of a single epoch, which the parallax displaces; ``frame`` (N,) is 0 for rows in
    the reference's frame and the number of a mission, from 1, for those in a frame of its own; ``shared`` (N,) is the
    part of the errors of a position (rad) that is that of its ``calibrator`` (N,), and which the rows of a source with
    this calibrator have in common; ``at_rest`` (5, N) marks the parallax and motion of quasars where they are not
    measured but known.

    ``further`` (2, 5, N) are values and errors of the parameters `FURTHER` of stars whose paths are not straight, zero
    for those that a star lacks; ``orbit`` (7, N) and ``averaged`` (N,) as in `bends`.
    """

    values: Array
    errors: Array
    epoch: Array
    correlations: Array | None = None
    radial_velocity: Array | None = None
    names: Texts | None = None
    columns: Mapping[str, Array] = field(default_factory=dict)
    apparent: Flags = None  # type: ignore[assignment]  # none of them by default
    frame: Indices = None  # type: ignore[assignment]  # the reference's by default
    calibrator: Texts = None  # type: ignore[assignment]  # none by default
    shared: Array = None  # type: ignore[assignment]  # zero by default
    at_rest: Flags = None  # type: ignore[assignment]  # none by default
    further: Array | None = None
    orbit: Array | None = None
    averaged: Array | None = None

    def __post_init__(self) -> None:
        # broadcast arrays take no memory, however many rows there are
        defaults: dict[str, Any] = {"apparent": np.False_, "at_rest": np.zeros((5, 1), dtype=bool)}
        defaults |= {"frame": np.int64(0), "calibrator": np.str_(""), "shared": np.float64(0.0)}
        for name, default in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.broadcast_to(default, (*default.shape[:-1], len(self))))

    def __len__(self) -> int:
        return len(self.epoch)

    @property
    def present(self) -> Flags:
        """Which parameters have a value with an error; shape (5, N)."""
        return np.isfinite(self.values) & np.isfinite(self.errors)

    @property
    def measured(self) -> Flags:
        """Which of these are not known of quasars at rest; shape (5, N)."""
        return self.present & ~self.at_rest

    def taken(self, part: Indices | slice | Flags) -> "Astrometry":
        """Return some of the objects."""

        def some(array: Any) -> Any:
            if isinstance(part, slice) or part.dtype == np.bool_:
                return array[..., part]
            return np.take(array, part, axis=-1)  # half the time of indexing

        arrays = {name: some(array) for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        return replace(self, **arrays, columns={name: some(column) for name, column in self.columns.items()})

    def covariance(self) -> Array:
        """Return the covariance of the five parameters, zero where one is missing; shape (N, 5, 5).

        With further parameters it is that of all ten, (N, 10, 10).
        """
        sigma = np.where(self.present, self.errors, 0.0).T
        if self.further is not None:
            sigma = np.concatenate([sigma, self.further[1].T], axis=1)
        covariance = np.zeros((len(self), *2 * sigma.shape[1:]))
        covariance[:, range(sigma.shape[1]), range(sigma.shape[1])] = sigma**2
        correlations = () if self.correlations is None else np.nan_to_num(self.correlations)
        for correlation, (i, j) in zip(correlations, ALL_PAIRS, strict=False):
            covariance[:, i, j] = covariance[:, j, i] = correlation * sigma[:, i] * sigma[:, j]
        return covariance


def by_errors(covariance: Array) -> tuple[Array, Array]:
    """Return errors (K, N) and correlations (K, K, N) of covariances (N, K, K), which are zero beside errors of 0."""
    errors = np.sqrt(np.einsum("nii->in", covariance))
    safe = np.where(errors > 0.0, errors, 1.0)
    return errors, np.moveaxis(covariance, 0, -1) / (safe[:, None] * safe)


def of_five(table: Astrometry) -> Astrometry:
    """Return a table without further parameters."""
    correlations = table.correlations if table.correlations is None else table.correlations[: len(PAIRS)]
    return replace(table, further=None, correlations=correlations)


def joined(*tables: Astrometry) -> Astrometry:
    """Return the rows of some tables as one, without names, radial velocities and further columns."""
    none = np.zeros((len(PAIRS), sum(map(len, tables))))  # the rows of a link have no further parameters
    names = ("values", "errors", "epoch", "correlations", "apparent", "frame", "calibrator", "shared", "at_rest")
    whole = [replace(t, correlations=none[:, : len(t)]) if t.correlations is None else t for t in tables]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in whole], axis=-1) for name in names}
    return Astrometry(**arrays)


def with_variance(table: Astrometry, variance: Array) -> Astrometry:
    """Return a table with variances (5, N) added to those of its errors; covariances do not change."""
    errors = np.sqrt(table.errors**2 + variance)
    if (correlations := table.correlations) is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            shrunk = np.concatenate([np.where(errors > 0.0, table.errors / errors, 1.0), np.ones((5, len(table)))])
        correlations = np.array([c * shrunk[i] * shrunk[j] for c, (i, j) in zip(correlations, ALL_PAIRS, strict=False)])
    return replace(table, errors=errors, correlations=correlations)


def positive_definite(matrices: Array, least: float = 0.0) -> Flags:
    """Return whether the eigenvalues of each matrix (N, K, K) are above ``least``; NaN is not; shape (N,)."""
    try:  # Cholesky factors take a sixth of the time of eigenvalues, but say nothing about single matrices
        np.linalg.cholesky(matrices - least * np.eye(matrices.shape[-1]) if least else matrices)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(matrices)[:, 0] > least)
    return np.ones(len(matrices), dtype=bool)


# Names of the kinds of rows by what is measured: 1 for a position, 2 for a parallax and 4 for a motion.
KINDS = (
    *("nothing", "position", "parallax", "position and parallax"),
    *("motion", "position and motion", "three-parameter", "five-parameter", "single epoch"),
)
SINGLE_EPOCH = KINDS.index("single epoch")


def kind_numbers(rows: Astrometry) -> Indices:
    """Return where in `KINDS` the kind of each row is, which follows from what is measured; shape (N,).

    One coordinate of a position or of a motion is enough.  A position alone is of a "single epoch" where it is marked
    so.  Raises ValueError for a position of which one coordinate has no value.
    """
    by_group = np.logical_or.reduceat(rows.measured, [0, 2, 3])
    if len(half := np.flatnonzero(by_group[0] & ~np.isfinite(rows.values[:2]).all(axis=0))):
        raise ValueError(f"only one coordinate of the position has a value in {named_rows(half)}")
    position, parallax, motion = by_group
    number = position + 2 * parallax + 4 * motion
    return np.where((number == KINDS.index("position")) & rows.apparent, SINGLE_EPOCH, number)


def kinds(rows: Astrometry) -> Texts:
    """Return the names of these kinds; raises ValueError as `kind_numbers`."""
    return np.array(KINDS, dtype="U24")[kind_numbers(rows)]


def named_rows(rows: Indices) -> str:
    """Return rows counted from 1, at most five of them."""
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return f"row {', '.join(str(row + 1) for row in rows[:5])}{more}"


def propagated(values: Array, radial_velocity: Array | None, epoch: Array, new_epoch: Array) -> Array:
    """Return (ra, dec, parallax, pmra, pmdec) at another epoch; all (5, N) in rad and rad/yr, epochs in Julian years.

    Uniform motion in space with light time (ERFA `pmsafe`).  ``radial_velocity`` is in km/s.  A missing value (NaN)
    counts as zero here and stays missing; a parallax that is not positive stays as it is and means a great distance.
    """
    moved = values.copy()
    moving = np.flatnonzero(new_epoch != epoch)
    if not len(moving):
        return moved
    ra, dec, parallax, pmra, pmdec = np.where(np.isfinite(values[:, moving]), values[:, moving], 0.0)
    distant = parallax <= 0.0
    velocity = np.zeros(len(moving)) if radial_velocity is None else np.nan_to_num(radial_velocity[moving])
    velocity[distant] = 0.0
    start, end = ((years[moving] - 2000.0) * DAYS_PER_YEAR for years in (epoch, new_epoch))
    path = ra, dec, pmra / np.cos(dec), pmdec, np.maximum(parallax, 0.0) / ARCSEC, velocity
    # the ufunc itself, because erfa.pmsafe warns about every distance that it has to assume
    ra2, dec2, motion_ra, motion_dec, parallax2, _, _ = erfa.ufunc.pmsafe(*path, J2000, start, J2000, end)
    known = np.isfinite(values[:, moving])
    # at an assumed distance the parallax that comes back is not that of the star
    near = ~distant & (np.abs(parallax2 * ARCSEC - parallax) < 0.1 * np.abs(parallax))
    moved[:2, moving] = ra2, dec2
    moved[2, moving] = np.where(near & known[2], parallax2 * ARCSEC, values[2, moving])
    moved[3, moving] = np.where(known[3], motion_ra * np.cos(dec2), np.nan)
    moved[4, moving] = np.where(known[4], motion_dec, np.nan)
    return moved


@lru_cache(maxsize=4)
def _earth(epochs: bytes) -> Array:
    """Return the Earth from the barycentre in au, shape (3, N); it takes most of the time of small problems."""
    years, place = np.unique(np.frombuffer(epochs), return_inverse=True)  # most rows share theirs with others
    # the ufunc itself, because erfa.epv00 warns about epochs before 1900, where it is off by 1e-5 au
    _, earth, _ = erfa.ufunc.epv00(J2000, (years - 2000.0) * DAYS_PER_YEAR)
    return np.moveaxis(np.asarray(earth["p"])[place], -1, 0)


def parallax_factors(ra: Array, dec: Array, epoch: Array) -> Array:
    """Return (p.s, q.s) with s from the Earth to the barycentre in au: the displacement by parallax; shape (2, N)."""
    to_barycentre = -(_earth if len(epoch) < KEPT_EPOCHS else _earth.__wrapped__)(epoch.tobytes())
    p, q, _ = triad(ra, dec)
    return np.stack([np.sum(p * to_barycentre, axis=0), np.sum(q * to_barycentre, axis=0)])


def bends(years: Array, orbit: Array | None = None, averaged: Array | None = None) -> Array:
    """Return the derivatives of (ra, dec, parallax, pmra, pmdec) by the parameters `FURTHER`; shape (N, 5, 5).

    ``years`` (N,) since the star's epoch; ``orbit`` (7, N) has period (yr), eccentricity, periastron (years since the
    epoch) and the Thiele-Innes elements A, B, F, G for a semi-axis of 1, zero for none.  An orbit displaces positions;
    its motion is not that of years.  Source: Binnendijk 1960, Properties of Double Stars.  ``averaged`` (N,) is half
    the time over which positions and motions are averages, 0 for those at the epoch.
    """
    square = (0.0 if averaged is None else averaged) ** 2
    bend = np.zeros((len(years), 5, 5))
    bend[:, 0, 0] = bend[:, 1, 1] = bend[:, 3, 2] = bend[:, 4, 3] = 0.5 * (years**2 - square / 3.0)
    bend[:, 3, 0] = bend[:, 4, 1] = years
    bend[:, 0, 2] = bend[:, 1, 3] = (years**3 - square * years) / 6.0
    if orbit is not None:
        period, e, periastron, a, b, f, g = orbit
        mean = (((years - periastron) / np.where(period > 0.0, period, 1.0) + 0.5) % 1.0 - 0.5) * 2.0 * np.pi
        anomaly = mean + 0.85 * e * np.sign(mean)
        for _ in range(KEPLER):
            anomaly -= (anomaly - e * np.sin(anomaly) - mean) / (1.0 - e * np.cos(anomaly))
        x, y = np.cos(anomaly) - e, np.sqrt(1.0 - e**2) * np.sin(anomaly)
        bend[:, 0, 4], bend[:, 1, 4] = b * x + g * y, a * x + f * y
    return bend


def offsets(ra: Array, dec: Array, from_ra: Array, from_dec: Array) -> Array:
    """Return (d alpha*, d dec) of positions as seen from others, in their tangent plane; shape (2, N), rad.

    No large numbers are subtracted except the angles themselves, and 24 h is not a discontinuity.
    """
    d_ra = ra - from_ra
    east = np.cos(dec) * np.sin(d_ra)
    north = np.sin(dec - from_dec) + 2.0 * np.cos(dec) * np.sin(from_dec) * np.sin(0.5 * d_ra) ** 2
    return np.stack([east, north])


def from_tangent_plane(x: Array, y: Array, ra: Array, dec: Array) -> Array:
    """Return (ra, dec) of points (x, y) in the tangent planes of positions, x to the east; shape (2, N), rad."""
    return np.stack(erfa.tpsts(x, y, ra, dec))


def julian_years(besselian: Array) -> Array:
    """Return the Julian years of Besselian ones, (N,)."""
    return np.asarray(erfa.epj(*erfa.epb2jd(besselian)))


@dataclass(frozen=True)
class Differences:
    """R rows: ``values`` f (R, 5), zero where absent, ``partials`` M (R, 5, 5), ``covariance`` V (R, 5, 5) and which
    of the five are ``present`` (R, 5).  M is (R, 5, 10) where sources have parameters `FURTHER`.

    ``by_frames`` (R, 5, 5 F) are the derivatives of f by the changes of the source's five parameters in the satellite's
    frame, and then in those of F - 1 further missions: M, and -M for the mission's frame that the row is in.
    ``calibrator`` and ``shared`` (R,) are those of the rows.
    """

    values: Array
    partials: Array
    covariance: Array
    present: Flags
    by_frames: Array
    calibrator: Texts
    shared: Array

    def across(self, rows: Indices) -> Array:
        """Return the covariance between rows (n, r) of sources whose positions share a calibrator; (n, r, 5, r, 5)."""
        names, sizes = self.calibrator[rows], self.shared[rows]
        same = (names[:, :, None] == names[:, None]) & ~np.eye(rows.shape[1], dtype=bool)
        size = np.where(same, sizes[:, :, None] * sizes[:, None], 0.0)
        return size[:, :, None, :, None] * np.diag([1.0, 1.0, 0.0, 0.0, 0.0])[:, None]

    def whole(self, star_covariance: Array) -> Array:
        """Return the covariance of the differences of each row; ``star_covariance`` (R, 5, 5) is that of its source."""
        return np.asarray(self.covariance + self.partials @ star_covariance @ self.partials.swapaxes(1, 2))


def differences(
    satellite: Astrometry,
    rows: Astrometry,
    source: Indices,
    spin: Array | None = None,
    frames: int = 1,
    at_rest: float = 2000.0,
) -> Differences:
    """Return rows - satellite.  ``source`` (R,) says to which source of the satellite a row belongs.

    A row without an epoch has that of its source, and a source without one that of the row; if it is at rest in the
    satellite's frame it is where it was at the epoch ``at_rest``.  f is the row minus the exact propagation of the
    satellite's parameters, and for the position of a single epoch minus the parallax times its factors.  A motion or
    parallax that the satellite lacks counts as zero here; it is free in the solution, so nothing depends on that.
    ``spin`` is a known (5, S) displacement of the sources' parameters that is taken out.  ``frames`` is 1 more than the
    number of missions whose rows are in frames of their own.
    """
    star = satellite.taken(source)
    epoch = np.where(np.isfinite(rows.epoch), rows.epoch, star.epoch)
    elsewhere = np.where(star.at_rest[3:].all(axis=0), at_rest, epoch)
    start = np.nan_to_num(np.where(np.isfinite(star.epoch), star.epoch, elsewhere), nan=2000.0)
    years = np.where(np.isfinite(epoch), epoch - start, 0.0)
    moved = propagated(star.values, star.radial_velocity, start, start + years)
    moved[2:] = np.nan_to_num(moved[2:])
    present = rows.present
    apparent = rows.apparent & ~present[2:].any(axis=0)

    partials = np.zeros((len(rows), 5, 5))
    partials[:, range(5), range(5)] = 1.0
    partials[:, 0, 3] = partials[:, 1, 4] = years
    with np.errstate(invalid="ignore"):
        values = rows.values - moved
        values[:2] = offsets(rows.values[0], rows.values[1], moved[0], moved[1])
    if len(at := np.flatnonzero(apparent)):
        factors = parallax_factors(moved[0, at], moved[1, at], epoch[at])
        partials[at, :2, 2] = factors.T
        values[:2, at] -= factors * moved[2, at]
    if spin is not None:
        values -= np.einsum("rij,jr->ir", partials, spin[:, source])
    if star.further is not None:
        bend = bends(years, star.orbit, star.averaged)
        bend[~apparent, :, 4] = 0.0  # like the parallax, an orbit is not seen in mean positions
        partials = np.concatenate([partials, bend], axis=2)
        values -= np.einsum("rij,jr->ir", bend, star.further[0])
    partials = partials * present.T[:, :, None]
    five = partials[..., :5]
    of_missions = (np.where((rows.frame == k)[:, None, None], -five, 0.0) for k in range(1, frames))
    by_frames = np.concatenate([five, *of_missions], axis=2)
    values, of_rows = np.where(present, values, 0.0).T, (rows.calibrator, rows.shared)
    return Differences(values, partials, rows.covariance(), present.T, by_frames, *of_rows)
