"""Mutation run: mistakes that a reader could make, made by rule, and whether the tests notice them.

`python benchmarks/mutants.py core/frames.py --sample 20` changes one expression or statement of the functions in these
files at a time, in a copy of the checkout, and runs the tests of their folder, which pass without the change. A mutant
is named by its function, so that the run needs no list of lines. It prints whether each was killed or survived (a few
cannot be told from the code by any result), and exits with 1 if fewer than ``--least`` were killed.
"""

import argparse
import ast
import compileall
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from py_compile import PycInvalidationMode

ROOT = Path(__file__).resolve().parent.parent
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

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    **{
        ast.Add: ast.Sub,
        ast.Sub: ast.Add,
        ast.Mult: ast.Div,
        ast.Div: ast.Mult,
        ast.Pow: ast.Mult,
        ast.FloorDiv: ast.Div,
    },
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin", "minimum": "maximum"}


@dataclass(frozen=True)
class Mutant:
    """A change of the text of a file from ``start`` to ``end``, inside a function."""

    file: str
    function: str
    start: int
    end: int
    old: str
    new: str

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.old, self.new))
        return f"{self.file}: {self.function}: {old} -> {new}"


def mutants(file: str) -> list[Mutant]:
    """Return all mutants of the functions in a file, whose path is relative to the checkout."""
    text = (ROOT / file).read_text()
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    content = text.encode()
    listed = []
    for function, node in _nodes(ast.parse(text), ""):
        for new in _changed(node):
            start, end = (starts[line - 1] + column for line, column in _ends(node))
            listed.append(Mutant(file, function, start, end, content[start:end].decode(), new))
    return listed


def _ends(node: ast.expr | ast.stmt) -> tuple[tuple[int, int], tuple[int, int]]:
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)


def _nodes(node: ast.AST, function: str) -> Iterator[tuple[str, ast.expr | ast.stmt]]:
    """Yield what can be changed in each function, with the name of the function."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            inner = f"{function}.{child.name}".lstrip(".")
            for statement in child.body:
                yield from _nodes(ast.Module([statement], []), inner)
        elif isinstance(child, ast.JoinedStr | ast.AnnAssign) and not getattr(child, "value", None):
            continue  # the words of a message, the type of a field
        else:
            if function and isinstance(child, ast.expr | ast.stmt):
                yield function, child
            yield from _nodes(child, function)


def _changed(node: ast.expr | ast.stmt) -> Iterator[str]:  # noqa: PLR0912 - a table, written as cases
    """Yield the texts that a node may be changed to."""
    match node:
        case ast.BinOp() if type(node.op) in OPERATORS and not _is_text(node):
            yield f"({ast.unparse(ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right))})"
        case ast.Compare(ops=[op]) if type(op) in OPERATORS:
            yield f"({ast.unparse(ast.Compare(node.left, [OPERATORS[type(op)]()], node.comparators))})"
        case ast.BoolOp():
            yield f"({ast.unparse(ast.BoolOp(OPERATORS[type(node.op)](), node.values))})"
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield f"({ast.unparse(node.operand)})"
        case ast.Constant(value=bool() as value):
            yield str(not value)
        case ast.Constant(value=int() as value):
            yield str(value + 1)
        case ast.Constant(value=float() as value):
            yield str(2.0 * value or 1.0)
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[first, *_]) if name == "sqrt":
            yield f"({ast.unparse(first)})"
        case ast.Name(id=name) if name in NAMES:
            yield NAMES[name]
        case ast.Attribute(attr="T"):
            yield ast.unparse(node.value)
        case ast.Attribute(attr=name) if name in NAMES:
            yield f"{ast.unparse(node.value)}.{NAMES[name]}"
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise():
            yield "pass"
        case ast.Continue():
            yield "break"


def _is_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(
        isinstance(s, ast.JoinedStr) or (isinstance(s, ast.Constant) and isinstance(s.value, str)) for s in sides
    )


def nearest_tests(file: str) -> tuple[str, ...]:
    """Return the folders of tests of a file: that of the same name, or the nearest above it; and of ties that of their
    commands too, by which the core of ties is tested.
    """
    folder = Path("tests") / Path(file).parent
    nearest = next(f for f in (folder, *folder.parents) if (ROOT / f).is_dir())
    return (str(nearest), "tests/sweep/tie") if nearest == Path("tests/core/tie") else (str(nearest),)


def copy_of_checkout(folder: Path) -> Path:
    """Return a copy in which files may be changed."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name in FILES:
        shutil.copy(ROOT / name, folder / name)
    # compiled once; of a changed file the hash is another, so that it is compiled again
    compileall.compile_dir(folder, quiet=2, invalidation_mode=PycInvalidationMode.CHECKED_HASH)
    return folder


def verdict(mutant: Mutant, tests: tuple[str, ...], copy: Path) -> str:
    """Return whether tests that pass without it notice a mutant."""
    if not _tests_pass(tests, copy):
        return "NO VERDICT"
    path = copy / mutant.file
    whole = path.read_bytes()
    path.write_bytes(whole[: mutant.start] + mutant.new.encode() + whole[mutant.end :])
    try:
        return "SURVIVED" if _run(tests, copy) else "killed"
    finally:
        path.write_bytes(whole)


@cache
def _tests_pass(tests: tuple[str, ...], copy: Path) -> bool:
    return _run(tests, copy)


def _run(tests: tuple[str, ...], copy: Path) -> bool:
    """Return whether tests pass in a child process, which has the libraries already but nothing of this project."""
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("files", nargs="*", default=["core", "sweep"], help="files or folders (default: all)")
    parser.add_argument("--function", default="", help="only functions with this in their name")
    parser.add_argument("--tests", nargs="+", help="the tests that must notice (default: the folder's)")
    parser.add_argument("--sample", type=int, help="so many mutants, by chance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--least", type=float, default=0.85, help="share that must be killed (default: %(default)s)")
    options = parser.parse_args()
    paths = [path for name in options.files for path in (sorted((ROOT / name).rglob("*.py")) or [ROOT / name])]
    listed = [mutant for path in paths for mutant in mutants(str(path.relative_to(ROOT)))]
    chosen = [mutant for mutant in listed if options.function in mutant.function]
    if options.sample is not None:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in LIBRARIES:  # once, what the tests of every mutant would take seconds to import
        import_module(name)
    for plugin in entry_points(group="pytest11"):
        plugin.load()
    verdicts = []
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_of_checkout(Path(folder))
        for mutant in chosen:
            start = time.monotonic()
            verdicts.append(verdict(mutant, tuple(options.tests or nearest_tests(mutant.file)), copy))
            print(f"{verdicts[-1]:10} {time.monotonic() - start:5.0f} s  {mutant}", flush=True)
    killed = verdicts.count("killed")
    print(f"{killed} of {len(chosen)} killed")
    return 0 if killed >= options.least * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
