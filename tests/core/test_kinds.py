"""A new catalogue, error model or mission is one file and its entry in one list: tried on a copy of the core."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

RING = """
import numpy as np

from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues.kind import CatalogueKind


class Ring(CatalogueKind):
    parameters = frozenset()

    def available(self, point):
        return 12

    def magnitudes(self, point):
        return 10.0, 10.0

    def draw(self, point, rng):
        n = self.size(point)
        zero = np.zeros(n)
        return Catalogue(2 * np.pi * np.arange(n) / n, np.linspace(-1.0, 1.0, n), zero, zero, zero + 10.0)
"""
DOUBLE = """
from linksweep.core.errors.model import Errors
from linksweep.core.errors.normal import Normal, NormalErrors


class Double(Normal):
    def uses(self, side):
        return frozenset()

    def model(self, point, side):
        return NormalErrors(2.0, 4.0)

    def errors_at(self, point, side, v_mag):
        return Errors(2.0, 4.0)

    def any(self, point, side, objects):
        return True
"""
FLAT = """
import numpy as np

from linksweep.core.missions.mission import LogLinear
from linksweep.core.missions.mission import Mission

FLAT = Mission(LogLinear((0.0, 9.0), (2.0, 2.0)), LogLinear((0.0, 9.0), (4.0, 4.0)), 1.0, np.inf, "a toy")
"""
TRIED = """
import numpy as np
from linksweep.core.experiment import evaluate, link

def sums(**changes):
    point = link.defaults() | changes
    assert link.check(point) is None, link.check(point)
    found = evaluate([point], 50, np.random.default_rng(1), np.random.default_rng(2))
    return link.summarise(found, np.array([50.0]), np.array([1.0]))["sigma_spin"][0]

toy = sums(catalogue="ring", satellite_errors="double")
assert toy == sums(catalogue="ring", satellite_errors="magnitude", model="flat")
assert link.parameter("catalogue").choices[-1] == "ring"
assert "it is for catalogue = 'quasars'" in link.unused(link.defaults() | {"catalogue": "ring"})["counts"]
print("as good")
"""


def test_a_toy_of_each_kind_takes_one_file_and_one_entry(tmp_path):
    for package in ("core", "linksweep", "sweep", "sweeps"):
        shutil.copytree(ROOT / package, tmp_path / package, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for folder, module, code, entry, anchor in (
        ("catalogues", "ring", RING, '"ring": Ring(),', '"file": File(),'),
        ("errors", "double", DOUBLE, '"double": Double(),', '"catalogue": Own(),'),
        ("missions", "flat", FLAT, '"flat": FLAT,', '"gaia-dr5": GAIA_DR5,'),
    ):
        (tmp_path / "core" / folder / f"{module}.py").write_text(code)
        registry = tmp_path / "core" / folder / "__init__.py"
        name = entry.split(": ")[1].strip("(),")
        text = registry.read_text().replace(anchor, f"{anchor}\n        {entry}")
        registry.write_text(text.replace("\n\n", f"\n\nfrom linksweep.core.{folder}.{module} import {name}\n", 1))
    ran = subprocess.run([sys.executable, "-c", TRIED], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.stdout == "as good\n", ran.stderr


def test_no_kind_is_asked_for_by_its_name_outside_of_its_module():
    """Only the lists of kinds, and the sentence about a missing file, know what kinds are called."""
    words = ('== "quasars"', '== "galaxies"', '== "radio-stars"', '== "synthetic"', '== "magnitude"', '== "normal"')
    for path in (ROOT / "core").rglob("*.py"):
        if path.name in ("calibrate.py", "spin_variance.py"):
            continue  # their kinds are columns of the paper's tables
        assert not any(word in path.read_text() for word in words), path
