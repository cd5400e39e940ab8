"""The names of astrometric quantities in archives, in upper or lower case."""

from collections.abc import Collection, Iterable, Mapping

VALUES: Mapping[str, tuple[str, ...]] = {
    "ra": ("ra", "RAdeg", "RArad", "ra_icrs", "_RA"),
    "dec": ("dec", "DEdeg", "DErad", "dec_icrs", "DE_ICRS", "_DE"),
    "parallax": ("parallax", "plx"),
    "pmra": ("pmra", "pm_ra_cosdec", "pm_ra"),
    "pmdec": ("pmdec", "pm_dec", "pmDE"),
    "ref_epoch": ("ref_epoch", "epoch", "pos_epoch", "mjd"),
    "radial_velocity": ("radial_velocity", "dr2_radial_velocity", "rv"),
}
"""Column names of each quantity, best first; those of its error are made from them.  _RA and _DE are last because
VizieR computes them for an epoch of its own.
"""

_ERROR_NAMES = ("{}_error", "{}_err", "e_{}", "sigma_{}", "{}_sigma")


def value_column(quantity: str, names: Collection[str]) -> str | None:
    """Return the column that holds a quantity; None for none."""
    return first_found(VALUES.get(quantity, (quantity,)), names)


def error_column(quantity: str, names: Collection[str], value: str | None = None) -> str | None:
    """Return the column that holds the error of a quantity, whose own column is ``value``; None for none."""
    stems = [value, quantity] if value else [quantity]
    return first_found([form.format(stem) for stem in stems for form in _ERROR_NAMES], names)


def first_found(wanted: Iterable[str], names: Collection[str]) -> str | None:
    """Return the column of the first wanted name that is found, ignoring case if need be; None if there is none."""
    in_any_case = {name.casefold(): name for name in reversed(list(names))}
    found = (name if name in names else in_any_case.get(name.casefold()) for name in wanted)
    return next((name for name in found if name is not None), None)
