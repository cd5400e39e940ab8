"""`apply`: a table of the satellite's frame in that of the reference, by the link of the two."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.units import Unit
from scipy.spatial.transform import Rotation

from linksweep.core.frames import DEGREE, MAS, Array, position, triad
from linksweep.core.tie.astrometry import PAIRS, Astrometry, named_rows
from linksweep.core.unknowns import PARAMETERS, Objects, link_unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.result import require_free, stored_table, write_at_once
from linksweep.sweep.tables.columns import ALONG_RA, CORRELATIONS, Columns, first_found, unit_of
from linksweep.sweep.tables.reader import read_table as read_file
from linksweep.sweep.tie.options import SIGNS
from linksweep.sweep.tie.tables import TableOptions, astrometric_table, built_in

if TYPE_CHECKING:
    import xarray as xr
    from astropy.table import Table

# The formats that astropy knows by the names of files.
FORMATS = (".csv", ".ecsv", ".fits", ".parquet")

# Epochs that differ by less (years) from those of the link's own table are of the same release.
SAME_EPOCH = 0.01

ROTATION = link_unknowns()


def apply(
    link: "xr.Dataset | str | Path",
    table: "str | Path | Table",
    output: str | Path | None = None,
    *,
    inverse: bool = False,
    epoch: float | None = None,
) -> "Table":
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
        epoch: the epoch (Julian year) of a table without a column of epochs.

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
    output = None if output is None else Path(output)
    if output is not None:
        require_free(output)
        if output.suffix not in FORMATS:
            raise SweepError(f"a table is written as {', '.join(FORMATS)}", str(output))
    if isinstance(link, (str, Path)):
        if (stored := stored_table(link)) is None or stored.kind != "tie":
            raise SweepError("is no link of two tables, which sweep tie -o writes", str(link))
        link = stored.dataset
    path = built_in(Path(table)) if isinstance(table, (str, Path)) else Path("the table")
    raw = read_file(path) if isinstance(table, (str, Path)) else table.copy()
    stars = astrometric_table(raw, str(path), "", TableOptions(epoch=epoch)).astrometry
    notes = _notes(link, stars, inverse, str(path))
    if not any(first_found(names, raw.colnames) for names in CORRELATIONS.items()):
        if stars.correlations is not None:
            raise SweepError("has no columns like ra_dec_corr for its correlations: write them first", str(path))
        notes.append("the table has no columns of correlations: those that the link adds are lost")
    read = Columns(raw, str(path))
    _put(read, _moved(stars, link, inverse), output is not None and output.suffix == ".csv")
    raw.meta["comments"] = [*raw.meta.get("comments", []), *notes]
    if output is not None:
        write_at_once(output, raw.write)  # it warns of long names in a FITS header
    return raw


def _notes(link: "xr.Dataset", stars: Astrometry, inverse: bool, path: str) -> list[str]:
    """Return what is to be said of a link and a table; raises SweepError where one cannot be applied to the other."""
    blocks = dict.fromkeys(map(str, link["block"].values.tolist()))
    applied = [name for name in blocks if name.partition(":")[0] not in link.attrs["missions"]]
    if further := [name for name in applied if name not in ROTATION.names]:
        raise SweepError(
            f"the link has {', '.join(further)} too, and only orientation and spin are applied: solve again"
        )
    known = [name for name in ("known_spin", "known_orientation") if link.attrs.get(name, "none") != "none"]
    if "bin" in link.dims or known:
        raise SweepError(f"the link is beside {' and '.join(known) or 'spins by bins'}: solve for orientation and spin")
    low, high = link.attrs.get("satellite_epochs", [link.attrs["epoch"]] * 2)
    other = np.flatnonzero((stars.epoch < low - SAME_EPOCH) | (stars.epoch > high + SAME_EPOCH))
    if len(other) and not inverse:
        epochs = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        said = f"epoch {stars.epoch[other[0]]:g} in {named_rows(other)}, and the link is of {epochs}"
        raise SweepError(f"{said}: the frame of another release is another one", path)
    if len(without := np.flatnonzero(~np.isfinite(stars.values[:2]).all(axis=0))):
        raise SweepError(f"no position in {named_rows(without)}", path)
    frames = "reference to the satellite" if inverse else "satellite to the reference"
    notes = [
        f"carried from the frame of the {frames} by {' and '.join(applied)}, with the covariance of the link added"
    ]
    notes += [f"the link has no {name}, which is not changed" for name in ROTATION.names if name not in applied]
    return [*notes, "rows are correlated with each other by the link, whose covariance they share"]


def _moved(stars: Astrometry, link: "xr.Dataset", inverse: bool) -> dict[str, Array]:
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
    values[0] += (ra - values[0] + np.pi) % (2.0 * np.pi) - np.pi
    values[1] = dec
    values[3:] = np.where(stars.present[3:], [np.sum(axis * velocity.T, axis=0) for axis in axes], np.nan)
    effect = ROTATION.matrix(Objects(ra, dec, *np.nan_to_num(values[3:])), years) * stars.present.T[..., None]
    # the axes of errors turn too, by so little (1e-7) that their covariance does not change
    whole = stars.covariance()[:, :5, :5] + effect @ covariance @ effect.swapaxes(1, 2)
    whole[:, [0, 1], [0, 1]] -= stars.shared[:, None] ** 2  # the part of a calibrator has a column of its own
    errors = np.where(stars.present, np.sqrt(np.einsum("nii->in", whole)), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        of_pairs = {(i, j): whole[:, i, j] / (errors[i] * errors[j]) for i, j in PAIRS}
    new = {name: values[i] for i, name in enumerate(PARAMETERS) if name != "parallax"}
    new |= {f"{name}_error": errors[i] for i, name in enumerate(PARAMETERS) if name != "parallax"}
    return new | {f"{PARAMETERS[i]}_{PARAMETERS[j]}_corr": values for (i, j), values in of_pairs.items()}


def _put(read: Columns, new: dict[str, Array], is_csv: bool) -> None:
    """Put quantities into their columns, in the units of these; raises SweepError for columns that cannot hold them."""
    for quantity, values in new.items():
        if (name := read.name(quantity)) not in read.names or name is None:
            continue
        unit, usual = read.table[name].unit, unit_of(quantity)
        if read.kind(name) not in "fiu" or (quantity in ALONG_RA and read.in_time(quantity)):
            read.problems.append(f"column {name!r} is text or in units of time: write it in {usual} first")
        elif is_csv and unit is not None and usual and Unit(unit) != Unit(usual):
            read.problems.append(f"column {name!r} is in {unit}, which CSV cannot say: write .ecsv or .fits")
        else:
            scale = 1.0 if not usual else DEGREE if quantity in ("ra", "dec") else MAS
            stated = read.numbers(name)
            before = read.quantity(quantity, "allowed", scale) if usual else stated
            some = np.isfinite(before) & (stated != 0.0)
            factor = np.median(before[some] / stated[some]) if np.any(some) else scale
            at = np.isfinite(before) & np.isfinite(values)
            read.table[name] = read.table[name].astype(np.float64)
            read.table[name][at] = values[at] / factor
    read.finish()
