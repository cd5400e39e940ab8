"""The requested unknowns, or else those that the tables determine."""

import numpy as np

from linksweep.core.arrays import Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.sources import SourceTable
from linksweep.core.unknowns import Unknowns, parse_unknowns
from linksweep.sweep.tie.options import Options


def unknowns_of(
    options: Options, own: Astrometry, rows: Astrometry, source: Indices, epoch: float, notes: list[str]
) -> Unknowns:
    """Return the unknowns of the options; if none are named, those of orientation and spin that the rows determine.

    A note is added if these are not both.  Raises ValueError for unknowns that do not exist.
    """
    missions = list(options.missions)
    named = [name.strip() for name in (options.unknowns or "").split(",") if name.strip()]
    of_missions = [name for name in named if name.partition(":")[0] in missions]
    text = ",".join(name for name in named if name not in of_missions)
    if options.unknowns is None or (not text and of_missions):
        of_reference = np.arange(len(rows)) if rows.frame is None else np.flatnonzero(rows.frame == 0)
        text = _determined(own, rows.taken(of_reference), source[of_reference], epoch)
        if text != "orientation,spin":
            notes.append(f"of orientation and spin the tables determine only the {text}")
    if options.degree is not None:
        text = _with_harmonics(text, options.degree)
    text = ",".join([text, *of_missions])
    for mission in missions:
        if not any(name.startswith(f"{mission}:") for name in of_missions):
            text += "," + _determined(own, rows, source, epoch, text, mission, missions)
    return parse_unknowns(text, options.bins, own.columns, options.corrections, missions)


def _with_harmonics(text: str, degree: int) -> str:
    """Return unknowns with glide and harmonics up to a degree beside each rotation."""
    names = [name.strip() for name in text.split(",")]
    for rotation, glide, harmonics in (
        ("orientation", "position_glide", "vsh_position"),
        ("spin", "glide", "vsh_motion"),
    ):
        if rotation in names:
            names += [glide] if glide not in names else []
            names += [f"{harmonics}:2-{degree}"] if degree > 1 else []
    return ",".join(names)


def _determined(
    own: Astrometry,
    rows: Astrometry,
    source: Indices,
    epoch: float,
    beside: str = "",
    mission: str = "",
    missions: list[str] | None = None,
) -> str:
    """Return those of orientation and spin, of the satellite or a mission, that rows determine together with others."""
    for blocks in (("orientation", "spin"), ("orientation",), ("spin",)):
        text = ",".join(f"{mission}:{block}" if mission else block for block in blocks)
        unknowns = parse_unknowns(f"{beside},{text}", missions=missions or ())
        table = SourceTable(Problem(own, rows, source, unknowns, epoch))
        try:
            table.solve(np.ones(len(own)))
        except LinkError:
            continue
        return text
    frame = f"the frame of {mission}" if mission else "the satellite's frame"
    raise LinkError(f"the tables determine neither the orientation nor the spin of {frame}")
