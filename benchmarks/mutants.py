"""Changes that a reader would make by mistake, and the tests that must notice: a mutation run with chosen mutants.

`python benchmarks/mutants.py` changes one line of a copy of the checkout at a time, as `benchmarks/mutants.toml` lists
them, and runs the tests named there; it exits with 1 if one passes or a text is not found exactly once.
`--only TEXT` takes the mutants of files or tests with TEXT in their name, `--sample N --seed S` some of them.
A mutant with a reason under `equivalent` is not run: no result can show it.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import tomllib
import traceback
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = Path(__file__).with_suffix(".toml")
TIME_LIMIT_S = 600


def mutants(only: str = "") -> list[dict[str, str]]:
    """Return the mutants with ``only`` in the name of their file or test."""
    listed = tomllib.loads(TABLE.read_text())["mutant"]
    return [mutant for mutant in listed if only in mutant["file"] or only in mutant["test"]]


def misplaced(mutant: dict[str, str]) -> str | None:
    """Return what is wrong with the text of a mutant, None if it stands once in its file."""
    count = (ROOT / mutant["file"]).read_text().count(mutant["old"])
    return None if count == 1 else f"{mutant['file']}: {mutant['old']!r} is found {count} times"


def copy_of_checkout(folder: Path) -> Path:
    """Return a copy in which files may be changed."""
    for name in ("core", "sweep", "sweeps", "tests", "benchmarks", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def survives(mutant: dict[str, str], copy: Path) -> bool:
    """Return whether the tests of a mutant pass in spite of it."""
    path = copy / mutant["file"]
    whole = path.read_text()
    path.write_text(whole.replace(mutant["old"], mutant["new"]))
    try:
        return _tests_pass(mutant["test"].split(), copy)
    finally:
        path.write_text(whole)


def _tests_pass(tests: list[str], copy: Path) -> bool:
    """Run tests in a child process, which has the libraries already but nothing of this project."""
    child = os.fork()
    if child == 0:
        code = 3
        try:
            signal.alarm(TIME_LIMIT_S)  # a loop without end is noticed too
            os.chdir(copy)
            sys.path.insert(0, str(copy))
            sys.dont_write_bytecode = True
            output = os.open("pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            import pytest

            code = int(pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=1", *tests]))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code in (2, 3, 4, 5):
        raise RuntimeError(
            f"pytest ends with {code} for {' '.join(tests)}: no verdict\n{(copy / 'pytest.log').read_text()}"
        )
    return code == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--only", default="", help="mutants of files or tests with this in their name")
    parser.add_argument("--sample", type=int, help="so many of them, by chance")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chosen = mutants(options.only)
    problems = [problem for mutant in chosen if (problem := misplaced(mutant)) is not None]
    chosen = [mutant for mutant in chosen if "equivalent" not in mutant and misplaced(mutant) is None]
    if options.sample is not None:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import astropy.table
    import scipy.optimize
    import scipy.spatial
    import scipy.stats
    import xarray

    assert all((astropy, scipy, xarray))  # loaded once for all children
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_of_checkout(Path(folder))
        for mutant in chosen:
            alive = survives(mutant, copy)
            survivors += [mutant] if alive else []
            said = "SURVIVED" if alive else "killed"
            print(f"{said:8}  {mutant['file']}: {mutant['old']} -> {mutant['new']}", flush=True)
    print(f"{len(chosen) - len(survivors)} of {len(chosen)} killed", *problems, sep="\n")
    return 1 if survivors or problems else 0


if __name__ == "__main__":
    sys.exit(main())
