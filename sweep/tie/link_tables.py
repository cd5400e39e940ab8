"""`tie`: the link of two tables as a labelled dataset."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.contract import SweepError
from sweep.tie.dataset import as_dataset
from sweep.tie.setup import Options, set_up
from sweep.tie.solution import RESAMPLES, solve_link

if TYPE_CHECKING:
    import xarray as xr


def tie(
    satellite: str | Path,
    reference: str | Path,
    unknowns: str | None = None,
    *,
    clip: str = "none",
    errors: str | Sequence[str] = "scaled",
    resamples: int = RESAMPLES,
    seed: int = 0,
    **options: Any,
) -> "xr.Dataset":
    """Return the link of two tables, reference - satellite, as a labelled dataset.

    ``satellite`` and ``reference`` are files as `sweep.tie.tables.read_table` reads them; the reference may be
    ``zero-motion`` (quasars).  ``unknowns`` as ``orientation,spin,vsh_motion:3``; ``clip`` as none, rayleigh, median:5,
    discrepancy, huber:2; ``errors`` names one or more of formal, scaled, jackknife, cells, bootstrap, sandwich, the
    first of them the main one.  Further options are those of `sweep.tie.setup.Options`.  Raises SweepError.
    """
    known = {field.name for field in fields(Options)}
    if unknown := sorted(set(options) - known):
        raise SweepError(f"no option {', '.join(unknown)}; there are {', '.join(sorted(known))}")
    asked = Options(unknowns=unknowns, **options)
    kinds = [name.strip() for name in errors.split(",")] if isinstance(errors, str) else list(errors)
    return as_dataset(solve_link(set_up(satellite, reference, asked), clip, kinds, resamples, seed), asked)
