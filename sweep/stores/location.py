"""Where a store is: a folder of this machine or a prefix in a bucket, with files that have names like ``a/b/c``.

Both can replace a file in one step, make one only if there is none (`create`), and replace one only if it has not
changed (`swap`); ledger, dataset and lock need nothing else.
"""

import fcntl
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Union
from uuid import uuid4

from linksweep.sweep.contract import SweepError

if TYPE_CHECKING:
    from linksweep.sweep.stores.bucket import Bucket

TAKING = ".taking"
"""Ends the name of the file that stands for the system's lock where there is none."""

UNFINISHED = ".partial"
"""Ends the name of a file that is being written."""

RESULTS = Path("results")
"""The folder where a run puts its store by default."""


@dataclass(frozen=True)
class Folder:
    """A folder of this machine; `get` and the like take the names of files in it, as ``a/b/c``."""

    path: Path
    named: str = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Let the path name the same folder whatever becomes the working folder; ``named`` is what it was given as."""
        object.__setattr__(self, "named", str(self.path))
        object.__setattr__(self, "path", self.path.absolute())

    def __str__(self) -> str:
        return self.named

    @property
    def name(self) -> str:
        """The folder's own name, whatever links lead to it: two names of one store have one lock."""
        return self._real.name

    @property
    def parent(self) -> "Folder":
        """The folder around it."""
        return Folder(self._real.parent)

    @property
    def _real(self) -> Path:
        """The path with links resolved as far as possible; `Path.resolve` raises where links form a loop."""
        return Path(os.path.realpath(self.path))

    def get(self, key: str) -> bytes | None:
        """Return the content of a file, None where there is none."""
        try:
            return self._at(key).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of files."""
        return {key: self.get(key) for key in keys}

    def put(self, key: str, content: bytes) -> None:
        """Write a file by renaming a finished one, and wait until it and its name are on the disk."""
        path = self._write(key, content, durable=True)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write files one by one, each in one step too, but without waiting for the disk."""
        for key, content in files.items():
            self._write(key, content, durable=False)

    def create(self, key: str, content: bytes) -> bool:
        """Write a file unless there is one, by linking a finished one to its name; return whether it was written."""
        path = self._at(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError), _finished(path, content, durable=True) as temporary:
            try:
                os.link(temporary, path)
            except FileExistsError:
                raise
            except OSError:  # a file system without links
                with path.open("xb") as file:
                    file.write(content)
            return True
        return False

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace a file if it still holds ``old``, while holding the system's lock on the file to be replaced.

        Return whether it was replaced; of two processes that try, only one succeeds.
        """
        path = self._at(key)
        with suppress(FileNotFoundError, FileExistsError), path.open("rb") as file, _alone(file, path):
            if self.get(key) == old and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                self._write(key, new, durable=True)
                return True
        return False

    def delete(self, key: str) -> None:
        """Remove a file if there is one."""
        self._at(key).unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove all files, and the folder with all its folders if nothing is left in them."""
        for key in self.keys():
            self.delete(key)
        for folder, _, _ in os.walk(self._real, topdown=False):
            with suppress(OSError):
                os.rmdir(folder)

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all finished files that begin with ``under``, a name with a slash at its end or empty."""
        found: list[str] = []
        for folder, folders, names in os.walk(self._at(under), onerror=_raise_unless_missing):
            relative = Path(folder).relative_to(self.path)
            for name in (*folders, *names):
                _refuse_special(os.path.join(folder, name), (relative / name).as_posix())
            found += [(relative / name).as_posix() for name in names if not name.endswith(UNFINISHED)]
        return sorted(found)

    def require_plain(self) -> None:
        """Raise OSError where something inside is neither a file nor a folder: who follows a link reads, and writes,
        what lies outside.
        """
        self.keys()

    def is_free(self) -> bool:
        """Return whether nothing is there, or a folder with nothing but files that a killed process did not finish."""
        if not self.path.exists():
            return not self.path.is_symlink()
        return self.path.is_dir() and all(p.name.endswith(UNFINISHED) and p.is_file() for p in self.path.iterdir())

    def obstacle(self) -> str | None:
        """Say what keeps a store from being made here: a file in the way, or a folder that cannot be written."""
        if self.path.exists():
            return None if self.path.is_dir() else "is a file, not a Zarr store"
        parent = next(p for p in self.path.absolute().parents if p.exists())
        if parent.is_dir() and os.access(parent, os.W_OK | os.X_OK):
            return None
        return f"cannot make a store there: {parent} is not a directory that can be written"

    @contextmanager
    def tidied(self) -> Iterator[None]:
        """Remove folders that were not there before and are empty now."""
        folders = (self.path, *self.path.parents)
        missing = [folder for folder in folders if not os.path.exists(folder)]  # no error where a name is too long
        try:
            yield
        finally:
            with suppress(OSError):
                for folder in missing:
                    folder.rmdir()

    def _at(self, key: str) -> Path:
        """Return where a file is or will be; raises OSError where that, or a folder on the way to it, is special."""
        names = key.rstrip("/").split("/")
        for number in range(1, len(names) + 1):
            name = "/".join(names[:number])
            _refuse_special(os.path.join(self.path, name), name)
        return self.path / key

    def _write(self, key: str, content: bytes, *, durable: bool) -> Path:
        path = self._at(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        with _finished(path, content, durable=durable) as temporary:
            temporary.replace(path)
        return path


@contextmanager
def _finished(path: Path, content: bytes, *, durable: bool) -> Iterator[Path]:
    """Give a temporary file beside ``path`` with this content; it is removed afterwards unless it was renamed."""
    temporary = path.with_name(f"{path.name}.{uuid4().hex[:12]}{UNFINISHED}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _alone(file: BinaryIO, path: Path) -> Iterator[None]:
    """Hold the system's lock on an open file; where there are none, as on some network disks, a file beside ``path``
    that only one process can make.  Raises FileExistsError where another has made that.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:
        guard = path.with_name(f"{path.name}{TAKING}")
        guard.touch(exist_ok=False)
        try:
            yield
        finally:
            guard.unlink(missing_ok=True)
    else:
        yield


def _refuse_special(path: str, name: str) -> None:
    try:
        mode = os.lstat(path).st_mode
    except OSError:  # nothing is there, or reading it will say why it cannot be
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        kind = "a symbolic link" if stat.S_ISLNK(mode) else "a pipe, a socket or a device"
        raise OSError(f"{name} is {kind}, which is neither read nor written through; remove it")


def _raise_unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error


Location = Union[Folder, "Bucket"]
"""A place for the files of a store.  Both kinds have the same methods, which raise OSError where they fail."""

Where = str | Path | Location
"""What may name a place: an address as a user writes it, a path, or the place itself."""


def located(where: Where) -> Location:
    """Return the place that an address or path names; raises SweepError for an address of no known kind,
    and for a bucket where obstore is not installed.
    """
    if not isinstance(where, str | Path):
        return where
    address = str(where)
    if address.startswith("s3:/"):  # pathlib makes one slash of two
        try:
            from linksweep.sweep.stores.bucket import bucket_at
        except ImportError as error:
            missing = f"stores in a bucket need obstore: pip install 'linksweep[s3]' ({error})"
            raise SweepError(missing, address) from error
        return bucket_at(address)
    scheme, separator, _ = address.partition("://")
    if separator:
        raise SweepError(f"cannot be a store: {scheme}:// is not known; a store is a path or s3://BUCKET/NAME", address)
    return Folder(Path(where))


@contextmanager
def reading(location: Location) -> Iterator[None]:
    """Turn an OSError into a SweepError that says that the store cannot be read."""
    try:
        yield
    except OSError as error:
        raise SweepError(f"cannot be read: {error.strerror or error}", str(location)) from error


@contextmanager
def writing(location: Location) -> Iterator[None]:
    """Turn an OSError into a SweepError that says that the store cannot be written, and what is lost: nothing."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise SweepError(f"cannot be written: {reason}; what was finished before is kept", str(location)) from error


def default_store(name: str) -> Path:
    """Return where the store of a study is by default."""
    return RESULTS / f"{name}.zarr"


def store_named(where: Where) -> Location:
    """Return the place that an address, a path or the name of a study names; an existing path takes precedence."""
    if isinstance(where, str) and Path(where).name == where:
        default = default_store(where.removesuffix(".toml"))
        with suppress(OSError, ValueError):  # names that no file can have
            if not Path(where).exists() and default.exists():
                return located(default)
    return located(where)


def short_name(store: Location) -> str:
    """Return the shortest text that `store_named` takes for a store."""
    text = str(store)
    name = Path(text).name.removesuffix(".zarr")
    return name if Path(text) == default_store(name) and not Path(name).exists() else text
