"""Changes that a reader would make by mistake, and the tests that must notice: a mutation run with chosen mutants.

`python benchmarks/mutants.py` changes one line of a copy of the checkout at a time, as `benchmarks/mutants.toml` lists
them, and runs the tests named there, which pass without the change. It says of each mutant whether it was killed,
survived, was not found (its text does not stand exactly once in its file) or has no verdict (its tests fail without
it), and exits with 1 unless all were killed. A mutant with a reason under `equivalent` is not run: no result shows it.
"""

import argparse
import compileall
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from collections import Counter
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from py_compile import PycInvalidationMode

ROOT = Path(__file__).resolve().parent.parent
TABLE = Path(__file__).with_suffix(".toml")
FOLDERS = ("core", "sweep", "sweeps", "linksweep", "tests", "benchmarks", "docs")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE")
TIME_LIMIT_S = 900
"""Of the tests of one mutant, far above what they take: a loop without end fails them too."""

LIBRARIES = (
    "astropy.table",
    "dask",
    "distributed",
    "erfa",
    "hypothesis",
    "pydantic",
    "rich.table",
    "scipy.stats",
    "zarr",
)

KILLED, SURVIVED, NOT_FOUND, NO_VERDICT = "killed", "SURVIVED", "NOT FOUND", "NO VERDICT"

Mutant = dict[str, str]


def mutants(only: str = "", table: Path = TABLE) -> list[Mutant]:
    """Return the mutants with ``only`` in the name of their file or test."""
    listed = tomllib.loads(table.read_text())["mutant"]
    return [mutant for mutant in listed if only in mutant["file"] or only in mutant["test"]]


def misplaced(mutant: Mutant) -> str | None:
    """Return what is wrong with the text of a mutant, None if it stands once in its file."""
    path = ROOT / mutant["file"]
    count = path.read_text().count(mutant["old"]) if path.is_file() else 0
    return None if count == 1 else f"{mutant['file']}: {mutant['old']!r} is found {count} times"


def copy_of_checkout(folder: Path) -> Path:
    """Return a copy in which files may be changed."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name in FILES:
        shutil.copy(ROOT / name, folder / name)
    # compiled once; of a changed file the hash is another, so that it is compiled again
    compileall.compile_dir(folder, quiet=2, invalidation_mode=PycInvalidationMode.CHECKED_HASH)
    return folder


def verdict(mutant: Mutant, copy: Path, baseline: bool = True) -> str:
    """Return what the tests of a mutant say of it; without a ``baseline`` they are taken to pass without it."""
    if misplaced(mutant) is not None:
        return NOT_FOUND
    if baseline and not _passes_unchanged(mutant["test"], copy):
        return NO_VERDICT
    path = copy / mutant["file"]
    whole = path.read_text()
    path.write_text(whole.replace(mutant["old"], mutant["new"]))
    try:
        return SURVIVED if _tests_pass(mutant["test"].split(), copy) else KILLED
    finally:
        path.write_text(whole)


@cache
def _passes_unchanged(tests: str, copy: Path) -> bool:
    return _tests_pass(tests.split(), copy)


def _tests_pass(tests: list[str], copy: Path) -> bool:
    """Run tests in a child process, which has the libraries already but nothing of this project."""
    child = os.fork()
    if child == 0:
        code = 3
        try:
            signal.alarm(TIME_LIMIT_S)
            os.setpgid(0, 0)
            os.chdir(copy)
            sys.path.insert(0, str(copy))
            sys.dont_write_bytecode = True
            os.environ |= {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}  # also for what the tests start
            output = os.open("pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            import pytest

            options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=1"]
            options += ["--basetemp", str(copy / "temporary")]  # nothing that other runs left matters
            options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of plugins that are imported already
            options += ["--all"] if any("::" in test for test in tests) else []  # a test that is named may be slow
            code = int(pytest.main([*options, *tests]))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    _, status = os.waitpid(child, 0)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # servers of tests that were ended
    return os.waitstatus_to_exitcode(status) == 0


def _import_libraries() -> None:
    """Import once what the tests of every mutant would take seconds to."""
    for name in LIBRARIES:
        import_module(name)
    for plugin in entry_points(group="pytest11"):
        plugin.load()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--only", nargs="*", default=[""], help="mutants of files or tests with this in their name")
    parser.add_argument("--table", type=Path, default=TABLE, help="a table of mutants (default: %(default)s)")
    parser.add_argument("--sample", type=int, help="so many of them, by chance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-baseline", action="store_true", help="take the tests to pass without a change")
    options = parser.parse_args()
    listed = mutants(table=options.table)
    chosen = [m for m in listed if any(m in mutants(only, options.table) for only in options.only)]
    chosen = [mutant for mutant in chosen if "equivalent" not in mutant]
    if options.sample is not None:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    _import_libraries()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_of_checkout(Path(folder))
        for mutant in chosen:
            start = time.monotonic()
            said = verdict(mutant, copy, not options.no_baseline)
            counts[said] += 1
            seconds = time.monotonic() - start
            print(f"{said:10} {seconds:5.0f} s  {mutant['file']}: {mutant['old']} -> {mutant['new']}", flush=True)
    print(f"{counts[KILLED]} of {len(chosen)} killed")
    return 0 if counts[KILLED] == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
