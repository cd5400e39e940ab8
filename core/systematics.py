"""Systematic errors of proper motions, the same in all realisations: fields that the link does not solve for."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.frames import along, triad
from linksweep.core.harmonics import Term, terms, toroidal, turned
from linksweep.core.unknowns import HIGHEST_DEGREE

Vector = tuple[float, float, float]
Pattern = tuple[tuple[Term, float], ...]


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
        return self.of_magnitude or bool(self.pattern)

    @property
    def of_magnitude(self) -> bool:
        """Whether anything depends on magnitudes."""
        return any(self.omega_slope) or any(self.magnitude_equation)

    def differences(self, ra: Array, dec: Array, v_mag: Array | None = None) -> Array:
        """Return what the terms add to the differences of (pmra, pmdec) of N objects; shape (2, N), in rad/yr."""
        found = np.zeros((2, len(ra)))
        if v_mag is not None:
            p, q, _ = triad(ra, dec)
            fainter, slope = v_mag - self.v_zero, np.array(self.omega_slope)
            found[0] += fainter * (along(slope, q) - self.magnitude_equation[0])
            found[1] -= fainter * (along(slope, p) + self.magnitude_equation[1])
        if self.pattern:
            found -= pattern_field(self.pattern, ra, dec)
        return found


def pattern_field(pattern: Pattern, ra: Array, dec: Array) -> Array:
    """Return a sum of vector spherical harmonics at positions (rad); components along east and north, (2, N)."""
    fields = toroidal(max(term.degree for term, _ in pattern), ra, dec)
    found = np.zeros((2, len(ra)))
    for term, coefficient in pattern:
        place = term.degree**2 - 1 + terms(term.kind, term.degree).index(term)
        found += coefficient * (fields[place] if term.kind == "t" else turned(fields[place]))
    return found


def rms(pattern: Pattern) -> float:
    """Return the RMS over the whole sky of the length of a field."""
    squares = sum(coefficient**2 * (1.0 if term.order == 0 else 2.0) for term, coefficient in pattern)
    return float(np.sqrt(squares / (4.0 * np.pi)))


@lru_cache(maxsize=256)
def parse_pattern(text: str) -> Pattern:
    """Return the harmonics of a line like ``t_2_0`` or ``t_2_0=0.5,s_2_1_re=-1``; a coefficient is 1 unless given.

    Raises ValueError that says what is wrong and what is known.
    """
    found: dict[Term, float] = {}
    for entry in filter(None, (entry.strip() for entry in text.split(","))):
        name, equals, number = (word.strip() for word in entry.partition("="))
        term = _term(name)
        if term in found:
            raise ValueError(f"{name} twice")
        found[term] = _coefficient(name, number) if equals else 1.0
    if not any(found.values()):
        raise ValueError("no harmonic with a coefficient that is not zero, such as 't_2_0=0.5,s_2_1_re'")
    return tuple(found.items())


def _term(name: str) -> Term:
    words = name.split("_")
    kind: str = words[0]
    if kind in ("t", "s") and len(words) > 1 and words[1].isdecimal() and 1 <= int(words[1]) <= HIGHEST_DEGREE:
        for term in terms("t" if kind == "t" else "s", int(words[1])):
            if term.label == name:
                return term
    raise ValueError(
        f"{name!r} is no vector spherical harmonic; those are t_L_0, t_L_M_re and t_L_M_im (toroidal) and s_L_0, ... "
        f"(spheroidal) of degrees L = 1 to {HIGHEST_DEGREE} and orders M = 1 to L, such as t_2_0 or s_2_1_re"
    )


def _coefficient(name: str, number: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if not abs(value) <= 1e8:
        raise ValueError(f"{name} = {number!r}: must be a number of mas/yr, at most 1e8")
    return value
