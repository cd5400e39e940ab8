"""What `import linksweep` gives: the names, their types, and that files of the user's with our names do no harm."""

import subprocess
import sys

import pytest

import linksweep
from tests.documents import ROOT

RUN = """
import linksweep
if __name__ == "__main__":
    study = {"title": "t", "axes": {"n_obj": [20, 40]}, "sampling": {"n_sim": 400}}
    ds = linksweep.run(study, "s.zarr", workers=2, pool="processes")
    print(ds.n_obj.values.tolist())
"""
TYPED = """
from collections.abc import Mapping, Sequence
from typing import Any
import xarray as xr
from numpy.random import Generator
import linksweep
from linksweep import Experiment, Output, Parameter, Point
def throw(points: Sequence[Point], n_sim: int, rng: Generator, catalogue_rng: Generator) -> Mapping[str, Any]:
    return {"sum": [rng.normal(p["mean"], 1.0, n_sim).sum() for p in points]}
experiment = Experiment(
    name="throws",
    version=1,
    parameters=(Parameter("mean", "float", 0.0, "mean of a throw"),),
    sums={"sum": ()},
    outputs=(Output("average", "", "average throw", headline=True),),
    evaluate=throw,
    summarise=lambda sums, n, n_cat: {"average": sums["sum"] / n},
)
dataset: xr.Dataset = linksweep.run("study.toml", pool="serial")
where: xr.Dataset = linksweep.find(dataset, "average < 1", over="mean")
"""


def python(folder, *arguments):
    return subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)


def test_there_is_one_name_to_import_and_every_function_says_what_it_takes_gives_and_raises():
    assert dir(linksweep) == sorted([*linksweep.__all__, "__version__"])
    assert not hasattr(linksweep, "spell")
    for name in linksweep.__all__:
        text = getattr(linksweep, name).__doc__
        if name.islower():
            assert all(part in text for part in ("Args:", "Returns:", "Raises:", "Example:", ">>> ")), name
        assert name in linksweep.__doc__
    for top in ("core", "sweep", "sweeps"):
        assert not (ROOT / top / "__init__.py").exists()  # a folder of the user's with this name is found first
        assert (ROOT / "linksweep" / top).resolve() == ROOT / top
    assert {"core", "sweep", "sweeps"}.isdisjoint(sys.modules)
    alone = python(ROOT, "-c", "import sys, linksweep; print(*sys.modules)").stdout.split()
    assert "linksweep" in alone
    assert {"numpy", "xarray", "dask", "click"}.isdisjoint(alone)  # to import it imports nothing large


@pytest.mark.slow  # mypy reads the types of xarray, Dask and all that they import
def test_a_users_script_sees_the_types(tmp_path):
    (tmp_path / "good.py").write_text(TYPED)
    (tmp_path / "bad.py").write_text('import linksweep\nlinksweep.run(3)\nlinksweep.plot("s.zarr")\n')
    said = python(tmp_path, "-m", "mypy", "--strict", "--cache-dir", tmp_path / "cache", "good.py", "bad.py").stdout
    assert "good.py" not in said
    for line, words in ((2, '"run" has incompatible type "int"'), (3, '"plot" has incompatible type "str"')):
        assert f"bad.py:{line}: error: Argument 1 to {words}" in said


def test_files_of_the_user_with_our_names_do_no_harm(tmp_path):
    (tmp_path / "sweeps.py").write_text("raise RuntimeError('a file of the user')")
    (tmp_path / "sweep.py").write_text(f"{RUN}    import core.helper\n")  # what a script is likely to be called
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "helper.py").write_text("print('helped')")
    done = python(tmp_path, "sweep.py")
    assert (done.returncode, done.stdout) == (0, "[20, 40]\nhelped\n"), done.stderr
