"""Parameter sweeps with Dask and Zarr, of the link of an astrometric satellite's frame or of any function.

This is the public interface; names that are not in ``__all__`` may change without notice.

=========================================  ==========================================================
`run`, `open`                              run a study, read the results in a store
`refine`                                   add points and realisations where they matter
`answer`, `plot`                           what results say, and their figure
`tie`, `difference`                        link two real tables, compare two such links
`forecast`, `apply`                        plan what to observe next, carry a table into the other frame
`load_study`, `Study`                      read and check a study without running it
`experiment`, `Parameter`, `Output`        declare more about a function than its signature says
`Experiment`                               declare an experiment of additive sums
`Point`                                    the type of one point's parameters, for annotations
`fit_power_law`, `fit_levelling`           laws along an axis
`find`, `interpolate`, `ratio`             where a limit is crossed, values between points, ratios
`sensitivity`                              Sobol indices: which parameters make a result vary
`Limits`                                   time and memory that one block of a run may take
`SweepError`                               bad input, or a state that you must know about
=========================================  ==========================================================

Example:
    >>> import linksweep
    >>> study = {
    ...     "title": "Two limits",
    ...     "axes": {"v_max": [14.0, 16.0]},
    ...     "fixed": {"catalogue": "quasars", "model": "gaia"},
    ...     "sampling": {"n_sim": 50, "seed": 1},
    ... }
    >>> ds = linksweep.run(study, "limits.zarr", pool="serial")
    >>> ds.n_obj.values.astype(int).tolist()
    [28, 315]
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from linksweep.sweep.analysis.laws import find, fit_levelling, fit_power_law, interpolate, ratio
    from linksweep.sweep.analysis.sensitivity import sensitivity
    from linksweep.sweep.api import answer, open, plot, refine, run  # noqa: A004
    from linksweep.sweep.contract import Experiment, Output, Parameter, Point, SweepError
    from linksweep.sweep.executing.pools import Limits
    from linksweep.sweep.functions.adapter import experiment
    from linksweep.sweep.studies.reader import load_study
    from linksweep.sweep.studies.study import Study
    from linksweep.sweep.tie.link import apply, forecast, tie
    from linksweep.sweep.tie.result import difference

    __version__: str

__all__ = [
    "Experiment",
    "Limits",
    "Output",
    "Parameter",
    "Point",
    "Study",
    "SweepError",
    "answer",
    "apply",
    "difference",
    "experiment",
    "find",
    "fit_levelling",
    "fit_power_law",
    "forecast",
    "interpolate",
    "load_study",
    "open",
    "plot",
    "ratio",
    "refine",
    "run",
    "sensitivity",
    "tie",
]

_MODULES = {
    "linksweep.sweep.analysis.laws": ("find", "fit_levelling", "fit_power_law", "interpolate", "ratio"),
    "linksweep.sweep.analysis.sensitivity": ("sensitivity",),
    "linksweep.sweep.api": ("answer", "open", "plot", "refine", "run"),
    "linksweep.sweep.contract": ("Experiment", "Output", "Parameter", "Point", "SweepError"),
    "linksweep.sweep.executing.pools": ("Limits",),
    "linksweep.sweep.functions.adapter": ("experiment",),
    "linksweep.sweep.studies.reader": ("load_study",),
    "linksweep.sweep.studies.study": ("Study",),
    "linksweep.sweep.tie.link": ("tie", "forecast", "apply"),
    "linksweep.sweep.tie.result": ("difference",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for: `import linksweep` alone takes milliseconds."""
    if name == "__version__":
        from importlib.metadata import version

        return version("linksweep")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'linksweep' has no attribute {name!r}")
    from linksweep.sweep.interrupt import watched

    with watched() as interruptions, interruptions.postponed():  # pandas that was imported by half cannot be again
        globals()[name] = value = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
