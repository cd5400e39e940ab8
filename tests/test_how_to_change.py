"""What docs/how-to-change-it.md says: a toy of each kind, made in the files that it names and in no others."""

import re
import shutil
import subprocess
import sys

import pytest

from tests.documents import ROOT
from tests.tiers import slow

PAGE, POOLS = (ROOT / "docs" / "how-to-change-it.md").read_text(), "sweep/executing/pools.py"
DOUBLE = '''
@dataclass(frozen=True)
class Double(ErrorModel):
    """Errors of 2 mas and 4 mas/yr."""
    def at(self, v_mag):
        return 2.0, 4.0
ERROR_MODELS = {**ERROR_MODELS, "double": Double}
'''
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
CATALOGUES = {**CATALOGUES, "ring": Ring()}
'''
FLAT = """
MISSIONS = {**MISSIONS, "flat": Mission(*[LogLinear((0.0, 9.0), (2.0, 2.0))] * 2, 1.0, np.inf, "a toy")}
"""
SOUTH = '''
def south(objects):
    """Return the derivatives by a constant in the declinations of the southern sky; shape (1, 1, N)."""
    return np.where(objects.dec < 0.0, 1.0, 0.0)[None, None]
KNOWN = {**KNOWN, "south": lambda asked: Block("south", ("south_dec",), (1,), False, south)}
'''
WORST = """
OUTPUTS = (*OUTPUTS, Output("sigma_worst", _EACH, "largest RMS error of a component"))
"""
IN_THE_SUMMARY = ('"chi2": sums["chi2"] / n,', '"sigma_worst": np.sqrt(variance[:, ALWAYS]).max(axis=1),')
DOTS = """
from matplotlib.figure import Figure
def dots(dataset, variables, over):
    figure = Figure()
    figure.add_subplot().plot(dataset[variables[0]].values.reshape(-1), "o")
    return figure
"""
A_KIND = ('"scatter": Kind("figure:scatter_figure"),', '"dots": Kind("dots:dots"),')
BACKWARDS = """
from contextlib import contextmanager
from linksweep.sweep.executing.pools import Place
from linksweep.sweep.executing.worker import compute
@contextmanager
def backwards(reference, workers):
    def execute(take):
        while jobs := take(3):
            for job in reversed(jobs):
                yield job, compute(job.task())
    yield Place("in this process, the last job first", 1), execute
"""
A_POOL = """
PoolName = Literal[PoolName, "backwards"]
POOLS = {**POOLS, "backwards": Pool("backwards", "linksweep.sweep.executing.backwards:backwards", has_workers=False)}
"""
LINK = """
import numpy as np
from linksweep.core.experiment import evaluate, link
point = link.defaults() | {"n_obj": 30, CHANGES}
sums = evaluate([point, point | {"error_scale": 2.0}], 50, np.random.default_rng(1), np.random.default_rng(2))
once, twice = link.summarise(sums, np.array([50.0, 50.0]), np.array([1.0, 1.0]))["sigma_spin_predicted"]
assert 0.0 < once < np.inf and np.isclose(twice, 2.0 * once)
"""
TIE = """
import linksweep
link = linksweep.tie("psrpi-de200", "timing-de200", "orientation,south")
assert link.unknown.values.tolist()[-1] == "south_dec"
assert link.unit.values[-1] == "mas"
"""
RUN = """
import linksweep
study = {"title": "A toy", "axes": {"n_obj": [30, 40, 50]}, "sampling": {"n_sim": 20}}
ds = linksweep.run(study, "toy.zarr", pool="serial")
"""
LARGEST = "assert (ds.sigma_worst == ds.sigma.max('component')).all()"
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
# by what is new: what comes at the end of files, which may be new, or behind a text in them; and a trial
TOYS = {
    "error model": ({"core/errors.py": DOUBLE}, LINK.replace("CHANGES", '"satellite_errors": "double"')),
    "catalogue": ({"core/catalogues.py": RING}, LINK.replace("CHANGES", '"catalogue": "ring"')),
    "mission": ({"core/missions/__init__.py": FLAT}, LINK.replace("CHANGES", '"model": "flat"')),
    "block of unknowns": ({"core/unknowns.py": SOUTH}, TIE),
    "output": ({"core/parameters.py": WORST, "core/experiment.py": IN_THE_SUMMARY}, RUN + LARGEST),
    "kind of plot": ({"sweep/plots/__init__.py": A_KIND, "sweep/plots/dots.py": DOTS}, RUN + PLOT),
    "pool of this machine": ({POOLS: A_POOL, POOLS.replace("pools", "backwards"): BACKWARDS}, RUN + POOL),
}


@pytest.mark.parametrize("toy", ["error model", *map(slow, [*TOYS][1:])])
def test_a_toy_of_each_kind_works_in_the_files_that_the_page_names(tmp_path, toy):
    for package in ("core", "linksweep", "sweep", "sweeps"):
        shutil.copytree(ROOT / package, tmp_path / package, symlinks=True)  # with what is compiled
    changes, trial = TOYS[toy]
    for file, change in changes.items():
        before = (tmp_path / file).read_text() if (tmp_path / file).exists() else ""
        behind, text = (before, change) if isinstance(change, str) else change
        assert before.count(behind) == 1
        (tmp_path / file).write_text(before.replace(behind, behind + text) if behind else text)
    ran = subprocess.run([sys.executable, "-c", trial], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_the_page_names_what_a_toy_touches_places_that_are_there_and_every_package():
    for what, (changes, _) in TOYS.items():
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| {what}"))
        files = {file if (ROOT / file).exists() else re.sub(r"\w+\.py$", "NAME.py", file) for file in changes}
        assert set(re.findall(r"`([\w/]+\.py)`", row)) == files
    places = re.findall(r"`((?:core|sweep|linksweep|tests)/[\w/]*(?:\.py)?)`", PAGE)
    assert [place for place in places if not ((ROOT / place).exists() or place.endswith("/NAME.py"))] == []
    packages = {f"sweep/{path.parent.name}/" for path in (ROOT / "sweep").glob("*/__init__.py")}
    assert packages | {"core/"} <= set(places)
