"""The local modules of a user's file: those of its folder that it imports, as in a script, visible to no other file.

They are modules of a package of their own, named after their content.  Import statements in them name that package
where they name a local module, so versions of a file, and files of one name in two folders, exist beside each other.
"""

import ast
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from types import ModuleType

OURS = "linksweep"
"""Our package, never looked for beside a user's file."""

PREFIX = "linksweep_local_"
"""Begins the names of the packages that local modules are in."""

SUFFIXES = (".py", *importlib.machinery.EXTENSION_SUFFIXES)

_packages: dict[str, "LocalFiles"] = {}


@dataclass(frozen=True, eq=False)
class LocalFiles(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """A file by its absolute path, and the contents of it and of the local modules it imports, by relative path.

    It finds and loads these modules itself, without bytecode, which Python takes by the second and the size of a file.
    """

    path: str
    contents: Mapping[str, bytes]

    @cached_property
    def digest(self) -> str:
        """The digest of all contents."""
        return hashlib.sha256(repr(sorted(self.contents.items())).encode()).hexdigest()[:12]

    @cached_property
    def package(self) -> str:
        """The name of the package that the modules are in."""
        return PREFIX + hashlib.sha256(f"{self.path} {self.digest}".encode()).hexdigest()[:12]

    @cached_property
    def modules(self) -> dict[str, str]:
        """The file of each module by its name in import statements, '' for a folder without ``__init__.py``."""
        files = {_dotted(file): file for file in self.contents}
        around = {name.rsplit(".", n)[0] for name in files for n in range(1, name.count(".") + 1)}
        return {"": "", **dict.fromkeys(around, ""), **files}

    def place(self, file: str) -> str:
        """Return the absolute path of one of the files."""
        return str(Path(self.path).parent / file)

    def name_of(self, filename: str) -> str | None:
        """Return the relative path of a file, None for one that is not among them."""
        return next((name for name in self.contents if filename == self.place(name)), None)

    def module(self) -> ModuleType:
        """Return the module of the file, executed once; raises whatever it raises."""
        if _packages.setdefault(self.package, self) is self and self not in sys.meta_path:
            sys.meta_path.insert(0, self)
        return importlib.import_module(f"{self.package}.{Path(self.path).stem}")

    def tree(self, file: str) -> ast.Module:
        """Return the syntax tree of a file in which imports of local modules name their package."""
        return _tree(self.package, file)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return how Python loads a module of the package."""
        package, _, name = fullname.partition(".")
        file = self.modules.get(name) if package == self.package else None
        if not file:
            return None if file is None else importlib.machinery.ModuleSpec(fullname, None, is_package=True)
        if not file.endswith(".py"):
            return importlib.util.spec_from_file_location(fullname, self.place(file))
        inside: list[str] | None = [] if file.endswith("__init__.py") else None
        return importlib.util.spec_from_file_location(
            fullname, self.place(file), loader=self, submodule_search_locations=inside
        )

    def exec_module(self, module: ModuleType) -> None:
        """Execute a module of the package."""
        file = self.modules[module.__name__.partition(".")[2]]
        exec(compile(self.tree(file), self.place(file), "exec", dont_inherit=True), vars(module))


def read_files(path: Path) -> LocalFiles:
    """Return a file with all modules of its folder that it imports, directly or through others, wherever the import
    statements are; raises OSError where the file cannot be read.
    """
    contents = {path.name: path.read_bytes()}
    todo = [path.name]
    for name in todo:  # which grows meanwhile
        for local in _imported(path.parent, name, contents[name]):
            if local not in contents:
                contents[local] = (path.parent / local).read_bytes()
                todo.append(local)
    return LocalFiles(str(path), contents)


def local_files_of(module: str) -> LocalFiles | None:
    """Return the files that a module belongs to, None for a module that was imported as usual."""
    return _packages.get(module.partition(".")[0])


def without_package(text: str) -> str:
    """Return a text without the packages of local modules."""
    return re.sub(rf"{PREFIX}[0-9a-f]+\.", "", text)


def _imported(folder: Path, name: str, content: bytes) -> Iterator[str]:
    """Yield the files of a folder that the import statements of one of them name."""
    try:
        nodes = list(ast.walk(ast.parse(content))) if name.endswith(".py") else []
    except (SyntaxError, ValueError, RecursionError):  # reported when the file is executed
        return
    package = PurePosixPath(name).parent.parts
    for node in nodes:
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            modules = [".".join([*base, *filter(None, [node.module]), alias.name]) for alias in node.names]
        for parts in (module.split(".") for module in modules if module.partition(".")[0] != OURS):
            for end in range(1, len(parts) + 1):
                stem = PurePosixPath(*parts[:end])
                files = [f"{stem}/__init__.py", *(f"{stem}{suffix}" for suffix in SUFFIXES)]  # as Python prefers them
                yield from [file for file in files if file != name and (folder / file).is_file()][:1]


def _dotted(file: str) -> str:
    stem = file.removesuffix(next(suffix for suffix in SUFFIXES if file.endswith(suffix)))
    return stem.removesuffix("/__init__").replace("/", ".")


@lru_cache(maxsize=256)
def _tree(package: str, file: str) -> ast.Module:
    files = _packages[package]
    tree = ast.parse(files.contents[file], files.place(file))
    _Localised(files, file).visit(tree)
    return ast.fix_missing_locations(tree)


class _Localised(ast.NodeTransformer):
    """Lets the import statements of a file name the package of the local modules."""

    def __init__(self, files: LocalFiles, file: str) -> None:
        self._package, self._file = files.package, file
        itself = {_dotted(file)} if "/" not in file else set()  # a file random.py may import Python's module random
        self._local = {name.partition(".")[0] for name in files.modules} - itself

    def visit_Import(self, node: ast.Import) -> ast.Import:
        names: list[ast.alias] = []
        for alias in node.names:
            top, _, below = alias.name.partition(".")
            whole = f"{self._package}.{alias.name}"
            if top not in self._local:
                names.append(alias)
            elif alias.asname or not below:
                names.append(ast.alias(whole, alias.asname or top))
            else:  # import a.b loads a.b and binds a
                names += [ast.alias(whole, "_"), ast.alias(f"{self._package}.{top}", top)]
        return ast.copy_location(ast.Import(names), node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom:
        if node.level and "/" not in self._file:
            raise ImportError("attempted relative import with no known parent package")
        if node.level or node.module is None or node.module.partition(".")[0] not in self._local:
            return node
        return ast.copy_location(ast.ImportFrom(f"{self._package}.{node.module}", node.names, 0), node)
