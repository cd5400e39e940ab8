"""Fields on the sky: vector spherical harmonics, and errors that objects share, systematic and zonal.

Systematic errors are the same in all realisations. A zonal field is isotropic, Gaussian and drawn exactly: a sum of
vector spherical harmonics, toroidal and spheroidal of equal power C_l ~ exp(-l (l + 1) L^2/2), the Gaussian of width
L on the sphere. So the covariance of two objects' errors depends on their distance alone, with the correlation sum (2
l + 1)/(4 pi) C_l d^l_11 in either direction (along the arc between them and across), close to exp(-distance^2/(2
L^2)) where L is small. Cost and memory grow with the number of objects, not with its square.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Literal, NamedTuple

import numpy as np

from linksweep.core.frames import OBSERVABLES, Array, along, triad

Kind = Literal["t", "s"]
KINDS: tuple[Kind, Kind] = ("t", "s")

HIGHEST_DEGREE = 50


class Term(NamedTuple):
    """One coefficient: kind t (toroidal) or s (spheroidal), degree, order, and part ("" for order 0, "re", "im")."""

    kind: Kind
    degree: int
    order: int
    part: str

    @property
    def label(self) -> str:
        """Return for example t_2_0 or s_3_1_re."""
        return "_".join(filter(None, [self.kind, str(self.degree), str(self.order), self.part]))


def terms(kind: Kind, degree: int) -> tuple[Term, ...]:
    """Return the 2 l + 1 coefficients of one kind and degree, by order, real before imaginary."""
    orders = [Term(kind, degree, m, part) for m in range(1, degree + 1) for part in ("re", "im")]
    return (Term(kind, degree, 0, ""), *orders)


def toroidal(degree: int, ra: Array, dec: Array) -> Array:
    """Return the toroidal fields of all degrees from 1 to ``degree``; shape (degree (degree + 2), 2, N).

    The fields are those that multiply the coefficients, with components along east and north: T_l0, then 2 Re T_lm
    and -2 Im T_lm for each order, degree by degree in the order of `terms`.  The spheroidal field of a term is the
    toroidal one turned by 90 deg: `turned`.  ``ra`` and ``dec`` are radians of shape (N,); poles are allowed.
    Source: Mignard & Klioner 2012, A&A 547, A59, Eqs. 2-8; fully normalised recurrences in the degree.
    """
    fields = np.empty((degree * (degree + 2), 2, len(ra)))
    fill_toroidal({d: fields[d**2 - 1 : d * (d + 2)] for d in range(1, degree + 1)}, ra, dec)
    return fields


def fill_toroidal(into: Mapping[int, Array], ra: Array, dec: Array) -> None:
    """Write the toroidal fields of some degrees into arrays of shape (2 degree + 1, 2, N), all orders at once."""
    highest = max(into)
    orders = np.arange(1, highest + 1)
    sin_dec, cos_dec = np.sin(dec), np.cos(dec)
    cosines, sines = _multiples(highest, ra)
    # P_lm/cos dec for the orders m = 1..l, of the degrees l - 1 and l
    # divided by cos dec, so that the poles need no exception
    before, here = np.zeros((2, highest, len(ra)))
    here[0] = np.sqrt(3.0 / (8.0 * np.pi))
    raised = sin_dec * here
    for degree in range(1, highest + 1):
        if degree > 1:
            low = orders[: degree - 1]  # from the two degrees below; the highest order from the degree before
            factor = np.sqrt((4 * degree**2 - 1) / (degree**2 - low**2))[:, None]
            below = np.sqrt(((degree - 1) ** 2 - low**2) / (4 * (degree - 1) ** 2 - 1))[:, None]
            before[: degree - 1] *= -below
            before[: degree - 1] += raised[: degree - 1]
            before[: degree - 1] *= factor
            np.multiply(here[degree - 2], np.sqrt((2 * degree + 1) / (2 * degree)) * cos_dec, out=before[degree - 1])
            before, here = here, before
            np.multiply(sin_dec, here[:degree], out=raised[:degree])
        if degree not in into:
            continue
        vectors, m, norm = into[degree], orders[:degree], 1.0 / np.sqrt(degree * (degree + 1))
        np.multiply(cos_dec, here[0], out=vectors[0, 0])  # dP_l0/d dec = sqrt(l (l + 1)) P_l1
        vectors[0, 1] = 0.0
        slope = (degree * norm) * raised[:degree]
        slope -= (norm * np.sqrt((2 * degree + 1) / (2 * degree - 1) * (degree**2 - m**2)))[:, None] * before[:degree]
        along = (norm * m)[:, None] * here[:degree]
        np.multiply(slope, -cosines[:degree], out=vectors[1::2, 0])
        np.multiply(along, sines[:degree], out=vectors[1::2, 1])
        np.multiply(slope, sines[:degree], out=vectors[2::2, 0])
        np.multiply(along, cosines[:degree], out=vectors[2::2, 1])


def _multiples(highest: int, ra: Array) -> tuple[Array, Array]:
    """Return 2 (-1)^m cos(m ra) and 2 (-1)^m sin(m ra) of the orders from 1; shape (highest, N)."""
    cosines, sines = np.empty((2, highest, len(ra)))
    turn_cos, turn_sin = -np.cos(ra), -np.sin(ra)
    # by the addition theorem: sines and cosines of every order would take most of the time
    cosines[0], sines[0] = 2.0 * turn_cos, 2.0 * turn_sin
    for m in range(1, highest):
        cosines[m] = cosines[m - 1] * turn_cos - sines[m - 1] * turn_sin
        sines[m] = sines[m - 1] * turn_cos + cosines[m - 1] * turn_sin
    return cosines, sines


def turned(fields: Array, out: Array | None = None) -> Array:
    """Return fields (..., 2, N) turned by 90 deg from east through north: toroidal ones become spheroidal."""
    out = np.empty_like(fields) if out is None else out
    np.negative(fields[..., 1, :], out=out[..., 0, :])
    out[..., 1, :] = fields[..., 0, :]
    return out


Vector = tuple[float, float, float]
Pattern = tuple[tuple[Term, float], ...]

# Degrees go up to this over the width: those beyond have exp(-12.5) of the power, which goes to those below.
REACH = 5.0

# Numbers in the fields of the objects that are prepared at a time: 8 MiB.
BASIS = 2**20


@dataclass(frozen=True)
class Systematics:
    """Terms of the differences of proper motions, reference - satellite, that no unknown stands for.

    ``omega_slope`` (rad/yr/mag): the spin is omega + slope (V - v_zero).  ``magnitude_equation``: the satellite's pmra
    and pmdec (rad/yr/mag) grow with V - v_zero by these.  ``pattern``: coefficients (rad/yr) of vector spherical
    harmonics in the satellite's proper motions.
    """

    omega_slope: Vector = (0.0, 0.0, 0.0)
    magnitude_equation: tuple[float, float] = (0.0, 0.0)
    v_zero: float = 0.0
    pattern: Pattern = ()

    def __bool__(self) -> bool:
        return self.need_magnitudes or bool(self.pattern)

    @property
    def need_magnitudes(self) -> bool:
        """Whether anything depends on magnitudes."""
        return any(self.omega_slope) or any(self.magnitude_equation)

    def differences(self, ra: Array, dec: Array, v_mag: Array | None = None) -> Array:
        """Return what the terms add to the differences of (pmra, pmdec) of N objects; shape (2, N), in rad/yr."""
        total = np.zeros((2, len(ra)))
        if v_mag is not None:
            p, q, _ = triad(ra, dec)
            fainter, slope = v_mag - self.v_zero, np.array(self.omega_slope)
            total[0] += fainter * (along(slope, q) - self.magnitude_equation[0])
            total[1] -= fainter * (along(slope, p) + self.magnitude_equation[1])
        return total - pattern_field(self.pattern, ra, dec) if self.pattern else total


def pattern_field(pattern: Pattern, ra: Array, dec: Array) -> Array:
    """Return a sum of vector spherical harmonics at positions (rad); components along east and north, (2, N)."""
    fields = toroidal(max(term.degree for term, _ in pattern), ra, dec)
    total = np.zeros((2, len(ra)))
    for term, coefficient in pattern:
        place = term.degree**2 - 1 + terms(term.kind, term.degree).index(term)
        total += coefficient * (fields[place] if term.kind == "t" else turned(fields[place]))
    return total


def rms(pattern: Pattern) -> float:
    """Return the RMS over the whole sky of the length of a field."""
    squares = sum(coefficient**2 * (1.0 if term.order == 0 else 2.0) for term, coefficient in pattern)
    return float(np.sqrt(squares / (4.0 * np.pi)))


@lru_cache(maxsize=256)
def parse_pattern(text: str) -> Pattern:
    """Return the harmonics of a line like ``t_2_0`` or ``t_2_0=0.5,s_2_1_re=-1``; a coefficient is 1 unless given.

    Raises ValueError that says what is wrong and what is known.
    """
    pattern: dict[Term, float] = {}
    for entry in filter(None, (entry.strip() for entry in text.split(","))):
        name, equals, number = (word.strip() for word in entry.partition("="))
        if (term := _terms_by_label().get(name)) is None:
            known = f"t_L_0, t_L_M_re, t_L_M_im (toroidal), s_L_0 ... (spheroidal) of degrees L = 1 to {HIGHEST_DEGREE}"
            raise ValueError(f"motion_field: {name!r} is no harmonic; those are {known}, M = 1 to L, like s_2_1_re")
        if term in pattern:
            raise ValueError(f"motion_field: {name} twice")
        try:  # NaN and infinity are numbers to float, and fail the next test
            pattern[term] = float(number) if equals else 1.0
        except ValueError:
            pattern[term] = np.nan
        if not abs(pattern[term]) <= 1e8:
            raise ValueError(f"motion_field: {name} = {number!r} must be a number of mas/yr, at most 1e8")
    if not any(pattern.values()):
        raise ValueError("motion_field: no harmonic with a coefficient that is not zero, such as 't_2_0=0.5,s_2_1_re'")
    return tuple(pattern.items())


@cache
def _terms_by_label() -> dict[str, Term]:
    return {t.label: t for kind in KINDS for degree in range(1, HIGHEST_DEGREE + 1) for t in terms(kind, degree)}


@dataclass(frozen=True)
class ZonalErrors:
    """RMS of a coordinate of position (rad) and proper motion (rad/yr), and the width of the kernel (rad)."""

    sigma_pos: float
    sigma_pm: float
    length: float

    @property
    def degree(self) -> int:
        """The highest degree."""
        return max(1, int(np.ceil(REACH / self.length)))

    @property
    def coefficients(self) -> int:
        """The number of coefficients of position and proper motion together."""
        return 4 * self.degree * (self.degree + 2)

    @cached_property
    def power(self) -> Array:
        """C_l of the degrees from 1 on for a variance of 1 in a coordinate: sum of (2 l + 1)/(4 pi) C_l is 1."""
        degrees = np.arange(1, self.degree + 1)
        # relative to the first degree, so that very wide kernels do not underflow
        power = np.exp(-0.5 * (degrees * (degrees + 1) - 2) * self.length**2)
        return np.asarray(power / np.sum((2 * degrees + 1) / (4.0 * np.pi) * power))

    @cached_property
    def scatter(self) -> Array:
        """The standard deviation of each coefficient of one kind, in the order of `toroidal`; order 0 has the variance
        of both parts.
        """
        each = [[np.sqrt(c), *[np.sqrt(0.5 * c)] * (2 * degree)] for degree, c in enumerate(self.power, start=1)]
        return np.concatenate(each)


@dataclass(frozen=True)
class Field:
    """The zonal errors of the objects of one catalogue."""

    errors: ZonalErrors
    ra: Array
    dec: Array

    def draw(self, rows: int, rng: np.random.Generator) -> Array:
        """Return the coefficients (2, 2 D, rows) of position and proper motion of some realisations, for an RMS of 1;
        those of a wider kernel use the first normals of a narrower one.
        """
        scatter = self.errors.scatter
        normals = rng.standard_normal((len(scatter), 2, 2, rows))  # degree by degree: toroidal, spheroidal
        scaled = (scatter[:, None, None, None] * normals).transpose(2, 0, 1, 3)
        return np.ascontiguousarray(scaled).reshape(2, -1, rows)

    def values(self, coefficients: Array, part: slice) -> Array:
        """Return the errors of the objects of a part in realisations that were drawn; shape (n, 4, rows)."""
        rows = coefficients.shape[2]
        values = np.zeros((len(self.ra[part]), 4, rows))
        for few, basis in self.bases(part):
            flat = basis.reshape(len(basis), -1).T
            for k, observables, sigma in self.sizes():
                drawn = (flat @ coefficients[k]).reshape(2, -1, rows)
                values[few, observables] = sigma * drawn.transpose(1, 0, 2)
        return values

    def bases(self, part: slice) -> Iterator[tuple[slice, Array]]:
        """Yield the harmonics of a part, a few objects at a time: their place in the part, and (2 D, 2, n)."""
        ra, dec = self.ra[part], self.dec[part]
        # the harmonics of all objects at once would be gigabytes for narrow kernels
        step = max(1, BASIS // self.errors.coefficients)
        for start in range(0, len(ra), step):
            few = slice(start, min(start + step, len(ra)))
            fields = toroidal(self.errors.degree, ra[few], dec[few])
            yield few, np.stack([fields, turned(fields)], axis=1).reshape(-1, 2, fields.shape[2])

    def sizes(self) -> Iterator[tuple[int, slice, float]]:
        """Yield the number, rows and RMS of the pairs of observables that have zonal errors."""
        for k, sigma in enumerate((self.errors.sigma_pos, self.errors.sigma_pm)):
            if sigma > 0.0:
                yield k, OBSERVABLES[k], sigma

    def covariance_through(self, gain: Array) -> Array:
        """Return the covariance of the unknowns from these errors; ``gain`` (N, 4, K), result (K, K)."""
        scatter = np.repeat(self.errors.scatter, 2)
        leaks = np.zeros((2, len(scatter), gain.shape[2]))
        for few, basis in self.bases(slice(None)):
            for k, observables, sigma in self.sizes():
                leaks[k] += sigma * np.tensordot(basis, gain[few, observables], axes=((2, 1), (0, 1)))
        leaks *= scatter[:, None]
        return np.asarray(np.einsum("mnk,mnl->kl", leaks, leaks))
