"""What docs/how-to-change-it.md says: a toy of each kind, made in the files that it names and in no others."""

import re
import shutil
import subprocess
import sys
from typing import NamedTuple

import pytest

from tests.documents import ROOT
from tests.tiers import slow

PAGE = (ROOT / "docs" / "how-to-change-it.md").read_text()


class Toy(NamedTuple):
    """A change: what goes behind texts of files, its trial, and at most one new file."""

    what: str
    edits: list[tuple[str, str, str]]
    trial: str
    new: str = ""
    code: str = ""


RING = '''

class Ring(CatalogueKind):
    """Twelve objects, or n_obj of them, on a spiral."""

    parameters = frozenset()

    def available(self, point):
        return 12

    def magnitudes(self, point):
        return 10.0, 10.0

    def draw(self, point, rng):
        n = self.size(point)
        zero = np.zeros(n)
        return Catalogue(2 * np.pi * np.arange(n) / n, np.linspace(-1.0, 1.0, n), zero, zero, zero + 10.0)
'''
DOUBLE = '''

@dataclass(frozen=True)
class Double(ErrorModel):
    """Errors of 2 mas and 4 mas/yr."""

    def at(self, v_mag):
        return 2.0, 4.0
'''
LINK = """
import numpy as np
from linksweep.core.experiment import evaluate, link

point = link.defaults() | {"n_obj": 30, CHANGES}
assert link.check(point) is None, link.check(point)
sums = evaluate([point], 50, np.random.default_rng(1), np.random.default_rng(2))
assert np.isfinite(link.summarise(sums, np.array([50.0]), np.array([1.0]))["sigma_spin"][0])
"""
RUN = """
import linksweep

study = {"title": "A toy", "axes": {"n_obj": [30, 40, 50]}, "sampling": {"n_sim": 20}}
ds = linksweep.run(study, "toy.zarr", pool="serial")
"""
SOUTH = '''

def south(objects):
    """Return the derivatives by a constant in the declinations of the southern sky; shape (1, 1, N)."""
    return np.where(objects.dec < 0.0, 1.0, 0.0)[None, None]
'''
DOTS = """
from matplotlib.figure import Figure
from linksweep.sweep.plots import GridFigure


def dots(dataset, variables, over):
    figure = Figure()
    figure.add_subplot().plot(dataset[variables[0]].values.reshape(-1), "o")
    return figure


DOTS = GridFigure(lambda dataset, variable: True, dots)
"""
BACKWARDS = """
from contextlib import contextmanager
from linksweep.sweep.executing.pools import Place
from linksweep.sweep.executing.worker import compute


@contextmanager
def backwards(reference, workers, limits):
    def execute(take):
        while jobs := take(3):
            for job in reversed(jobs):
                yield job, compute(job.task(limits, 0.0))

    yield Place("in this process, the last job first", 1), execute
"""

PLOT = """
assert len(linksweep.plot(ds, "dots").axes[0].lines) == 1
from linksweep.sweep.cli.look import plot
assert any("dots" in getattr(option.type, "choices", ()) for option in plot.params)
"""
POOL = """
again = linksweep.run(study, "again.zarr", pool="backwards")
assert again.drop_vars("wall_time").drop_attrs().identical(ds.drop_vars("wall_time").drop_attrs())
from linksweep.sweep.cli.run import run as command
assert any("backwards" in getattr(option.type, "choices", ()) for option in command.params)
"""
TIE = """
import linksweep

link = linksweep.tie("psrpi-de200", "timing-de200", "orientation,south")
assert link.unknown.values.tolist()[-1] == "south_dec"
assert link.unit.values[-1] == "mas"
"""
ERRORS, CATALOGUES, UNKNOWNS = "core/errors.py", "core/catalogues.py", "core/unknowns.py"
FLAT = '\n        "flat": Mission(*[LogLinear((0.0, 9.0), (2.0, 2.0))] * 2, 1.0, np.inf, "a toy"),'
OWN = '\n    "south": lambda asked: Block("south", ("south_dec",), (1,), False, south),'
WORST = '    Output("sigma_worst", _EACH, "largest RMS error of a component"),\n'
ENTRY = '\n    "backwards": Pool("backwards", "linksweep.sweep.executing.backwards:backwards", has_workers=False),'
POOLS = "sweep/executing/pools.py"
TOYS = [
    Toy(
        "error model",
        [
            (ERRORS, "        return cls(0.0, 0.0)\n", DOUBLE),
            (ERRORS, '"catalogue": CatalogueErrors,', '\n        "double": Double,'),
        ],
        LINK.replace("CHANGES", '"satellite_errors": "double"'),
    ),
    Toy(
        "catalogue",
        [
            (CATALOGUES, '            return f"{said} ({where})" if where else said\n', RING),
            (CATALOGUES, '"file": File(),', '\n        "ring": Ring(),'),
        ],
        LINK.replace("CHANGES", '"catalogue": "ring"'),
    ),
    Toy(
        "mission",
        [("core/missions/__init__.py", '"gaia-dr5": _release("dr5", 120),', FLAT)],
        LINK.replace("CHANGES", '"satellite_errors": "magnitude", "model": "flat"'),
    ),
    Toy(
        "block of unknowns",
        [
            (UNKNOWNS, "    return np.ones((1, 1, len(objects.ra)))\n", SOUTH),
            (UNKNOWNS, "(PARALLAX,), False, constant),", OWN),
        ],
        TIE,
    ),
    Toy(
        "output",
        [
            ("core/parameters.py", "\nOUTPUTS = (\n", WORST),
            ("core/experiment.py", '"sigma": np.sqrt(variance),', '"sigma_worst": np.sqrt(variance).max(axis=1),'),
        ],
        RUN + "assert (ds.sigma_worst == ds.sigma.max('component')).all()\n",
    ),
    Toy(
        "kind of plot",
        [("sweep/plots/__init__.py", '"scatter": Kind("grid:SCATTER"),', '\n    "dots": Kind("dots:DOTS"),')],
        RUN + PLOT,
        *("sweep/plots/dots.py", DOTS),
    ),
    Toy(
        "pool of this machine",
        [
            (POOLS, 'PoolName = Literal["processes", "threads", "serial"', ', "backwards"'),
            (POOLS, "has_workers=False),", ENTRY),
        ],
        RUN + POOL,
        *("sweep/executing/backwards.py", BACKWARDS),
    ),
]


@pytest.mark.parametrize("toy", [TOYS[0], *map(slow, TOYS[1:])], ids=lambda toy: toy.what)
def test_a_toy_of_each_kind_works_in_the_files_that_the_page_names(tmp_path, toy):
    for package in ("core", "linksweep", "sweep", "sweeps"):
        shutil.copytree(ROOT / package, tmp_path / package, symlinks=True)  # with what is compiled
    if toy.new:
        (tmp_path / toy.new).write_text(toy.code)
    for file, behind, text in toy.edits:
        before = (tmp_path / file).read_text()
        assert before.count(behind) == 1, f"{behind!r} in {file}"
        (tmp_path / file).write_text(before.replace(behind, behind + text))
    ran = subprocess.run([sys.executable, "-c", toy.trial], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_the_page_names_what_a_toy_touches_places_that_are_there_and_every_package():
    for toy in TOYS:
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| {toy.what}"))
        new = {re.sub(r"\w+\.py$", "NAME.py", toy.new)} if toy.new else set()
        assert set(re.findall(r"`([\w/]+\.py)`", row)) == {file for file, _, _ in toy.edits} | new
        assert not toy.new or not (ROOT / toy.new).exists()
    places = re.findall(r"`((?:core|sweep|linksweep|tests)/[\w/]*(?:\.py)?)`", PAGE)
    assert [place for place in places if not ((ROOT / place).exists() or place.endswith("/NAME.py"))] == []
    packages = {f"sweep/{path.parent.name}/" for path in (ROOT / "sweep").glob("*/__init__.py")}
    assert packages | {"core/"} <= set(places)
