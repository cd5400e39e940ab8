"""Reads a user's file and the local modules that it imports, and makes modules of them that cannot be confused with
others of the same name.
"""

import ast
import builtins
import hashlib
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.machinery import ModuleSpec
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any

OURS = ("core", "sweep", "sweeps", "linksweep")
"""Our packages, never looked for beside a user's file."""

INSTALLED = {"site-packages", "dist-packages"}
"""Names of folders in which installed distributions are."""

_lock = threading.RLock()


@dataclass(frozen=True)
class Sources:
    """A file by its absolute path, and the contents of it and of the local modules it imports, by relative path."""

    path: str
    files: Mapping[str, bytes]

    @cached_property
    def digests(self) -> dict[str, str]:
        """The digest of each file."""
        return {name: hashlib.sha256(content).hexdigest()[:12] for name, content in self.files.items()}

    @property
    def parts(self) -> dict[str, str]:
        """What a store records: the digest of each file by ``file NAME``."""
        return {f"file {name}": digest for name, digest in self.digests.items()}

    @property
    def digest(self) -> str:
        """The digest of all files; that of the file itself if it imports no local module."""
        if len(self.digests) == 1:
            return next(iter(self.digests.values()))
        return hashlib.sha256(repr(sorted(self.digests.items())).encode()).hexdigest()[:12]

    @property
    def name(self) -> str:
        """The name of the file's module."""
        return Path(self.path).stem


def read_sources(path: Path, folder: Path | None = None) -> Sources:
    """Return a file with all modules of its ``folder`` that it imports, directly or through others, wherever the import
    statements are; raises OSError where the file cannot be read.
    """
    folder = folder or path.parent
    main = path.relative_to(folder).as_posix()
    files = {main: path.read_bytes()}
    todo = [main]
    while todo:
        name = todo.pop()
        for found in _imported_files(folder, name, files[name]):
            if found not in files:
                files[found] = (folder / found).read_bytes()
                todo.append(found)
    return Sources(str(path), {main: files.pop(main), **dict(sorted(files.items()))})


def _imported_files(folder: Path, name: str, content: bytes) -> list[str]:
    """Return the files of a folder that the import statements of one of them name."""
    try:
        nodes = list(ast.walk(ast.parse(content)))
    except (SyntaxError, ValueError, RecursionError):  # reported when the file is executed
        return []
    package = _dotted(name) if name.endswith("__init__.py") else _dotted(name).rpartition(".")[0]
    modules: list[str] = []
    for node in nodes:
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node.module or "", package, node.level)
            modules += [base, *(f"{base}.{alias.name}" if base else alias.name for alias in node.names)]
    found = []
    for module in modules:
        parts = module.split(".")
        if parts[0] in OURS:
            continue
        for end in range(1, len(parts) + 1):
            stem = PurePosixPath(*parts[:end])
            found += [f for f in (f"{stem}.py", f"{stem}/__init__.py") if f != name and (folder / f).is_file()][-1:]
    return found


def _absolute(name: str, package: str, level: int) -> str:
    """Return the whole name of a module that an import statement in a package names, with ``level`` dots before it."""
    if not level:
        return name
    parts = package.split(".") if package else []
    return ".".join([*parts[: len(parts) - level + 1], *([name] if name else [])])


def _dotted(name: str) -> str:
    return name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def make_module(sources: Sources, key: str) -> ModuleType:
    """Execute a file and return its module, also as ``sys.modules[key]``; raises whatever the file raises.

    An import statement in it, or in a local module, finds the local modules of these sources first, as in a script;
    no other code can import them.
    """
    return _Modules(sources, key).load(sources.name)


def forget_module(key: str) -> None:
    """Remove a module that `make_module` made, and its local modules."""
    with _lock:
        for name in [name for name in sys.modules if name == key or name.startswith(f"{key}//")]:
            del sys.modules[name]


class _Modules:
    """The modules of some sources, by their names in import statements."""

    def __init__(self, sources: Sources, key: str) -> None:
        self._key, self._folder = key, Path(sources.path).parent
        self._main = sources.name
        main = Path(sources.path).name
        self._files = {_dotted(name): name for name in sources.files if name != main} | {self._main: main}
        self._contents = sources.files
        packages = {".".join(name.split(".")[:end]) for name in self._files for end in range(1, name.count(".") + 1)}
        self._packages = packages | {name for name, file in self._files.items() if file.endswith("__init__.py")}
        self._names = self._packages | set(self._files)
        self._loaded: dict[str, ModuleType] = {}

    def load(self, name: str) -> ModuleType:
        """Return a module, executed once, with the packages around it."""
        with _lock:
            if name in self._loaded:
                return self._loaded[name]
            if name not in self._names:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            around, _, last = name.rpartition(".")
            package = self.load(around) if around else None
            if name in self._loaded:  # imported by the package
                return self._loaded[name]
            module = self._execute(name)
            if package is not None:
                setattr(package, last, module)
            return module

    def _execute(self, name: str) -> ModuleType:
        key = self._key if name == self._main else f"{self._key}//{name}"
        module = ModuleType(key)
        module.__spec__ = ModuleSpec(key, None, is_package=name in self._packages)
        module.__package__ = ""
        module.__dict__["__builtins__"] = vars(builtins) | {"__import__": self._importer(name)}
        if name in self._packages:
            module.__path__ = []
        sys.modules[key] = self._loaded[name] = module
        try:
            if (file := self._files.get(name)) is not None:  # else a folder without __init__.py
                module.__file__ = str(self._folder / file)
                exec(compile(self._contents[file], module.__file__, "exec", dont_inherit=True), module.__dict__)
        except BaseException:
            del sys.modules[key], self._loaded[name]
            raise
        return module

    def _importer(self, module: str) -> Any:
        """Return the function that the import statements of a module call."""
        package = module if module in self._packages else module.rpartition(".")[0]

        def import_module(
            name: str,
            globals: Any = None,  # noqa: A002 (the names are Python's)
            locals: Any = None,  # noqa: A002
            fromlist: Sequence[str] | None = (),
            level: int = 0,
        ) -> ModuleType:
            whole = _absolute(name, package, level)
            top = whole.partition(".")[0]
            if top not in self._names or top in OURS or (not level and whole == module == self._main):
                return builtins.__import__(name, globals, locals, fromlist or (), level)
            found = self.load(whole)
            if not fromlist:
                return self.load(top)
            for attribute in fromlist:
                if not hasattr(found, attribute) and f"{whole}.{attribute}" in self._names:
                    self.load(f"{whole}.{attribute}")
            return found

        return import_module
