"""Where a store is: a folder of this machine or a prefix in a bucket, as whole files with names like ``a/b/c``.

Both replace a file in one step, make one only if there is none (`create`), and replace one only if it is still what
it was (`swap`); ledger, dataset and lock need nothing else.
"""

import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from uuid import uuid4

from sweep.contract import SweepError

UNFINISHED = ".partial"
"""Ends the name of a file that is being written."""


class Location(Protocol):
    """A place for the files of a store; what fails raises OSError."""

    @property
    def name(self) -> str:
        """The last part of the place's name."""

    @property
    def parent(self) -> "Location":
        """The place around this one, where a file beside the store would be."""

    def get(self, key: str) -> bytes | None:
        """Return the content of a file, None where there is none."""

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of files, as `get`."""

    def put(self, key: str, content: bytes) -> None:
        """Write a file, or replace it in one step, so that it is there after a loss of power."""

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write files in any order, each as `put` does but without waiting for the disk."""

    def create(self, key: str, content: bytes) -> bool:
        """Write a file unless there is one; return whether it was written."""

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace a file that still holds ``old``; return whether it did, of two who try only one."""

    def delete(self, key: str) -> None:
        """Remove a file if there is one."""

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all files whose names begin with ``under``, which ends with a slash or is empty."""

    def is_free(self) -> bool:
        """Return whether nothing is there, but for the first file that a killed process did not finish."""

    def obstacle(self) -> str | None:
        """Say what keeps a store from being made here, as far as that can be told without trying."""

    def tidied(self) -> AbstractContextManager[None]:
        """Leave no empty folders behind that were not there before."""


Where = str | Path | Location
"""What may name a place: an address as a user writes it, a path, or the place itself."""


def located(where: Where) -> Location:
    """Return the place that an address or path names; raises SweepError for an address of no known kind."""
    if not isinstance(where, str | Path):
        return where
    address = str(where)
    if address.startswith("s3:/"):  # pathlib makes one slash of two
        from sweep.bucket import bucket_at

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


@dataclass(frozen=True)
class Folder:
    """A folder of this machine."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        """The folder's own name, whatever links lead to it: two names of one store have one lock."""
        return self.path.resolve().name

    @property
    def parent(self) -> "Folder":
        """The folder around it."""
        return Folder(self.path.resolve().parent)

    def get(self, key: str) -> bytes | None:
        """Return the content of a file, None where there is none."""
        try:
            return (self.path / key).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of files."""
        return {key: self.get(key) for key in keys}

    def put(self, key: str, content: bytes) -> None:
        """Write a file by renaming a finished one, and wait until both are on the disk."""
        path = self._write(key, content, durable=True)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write files one by one."""
        for key, content in files.items():
            self._write(key, content, durable=False)

    def create(self, key: str, content: bytes) -> bool:
        """Write a file unless there is one, by linking a finished one to its name."""
        path = self.path / key
        path.parent.mkdir(parents=True, exist_ok=True)
        with _finished(path, content, durable=True) as temporary:
            try:
                os.link(temporary, path)
            except FileExistsError:
                return False
            except OSError:  # a file system without links
                return _create_directly(path, content)
        return True

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace a file that still holds ``old``: who has the system's lock on the very file that is to go may do
        so.
        """
        path = self.path / key
        try:
            descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if self.get(key) != old or not os.path.samestat(os.fstat(descriptor), path.stat()):
                return False
            self._write(key, new, durable=True)
            return True
        except FileNotFoundError:
            return False
        finally:
            os.close(descriptor)

    def delete(self, key: str) -> None:
        """Remove a file if there is one."""
        (self.path / key).unlink(missing_ok=True)

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all finished files below a folder of it."""
        found: list[str] = []
        for folder, _, names in os.walk(self.path / under, onerror=_raise_unless_missing):
            relative = Path(folder).relative_to(self.path)
            found += [(relative / name).as_posix() for name in names if not name.endswith(UNFINISHED)]
        return sorted(found)

    def is_free(self) -> bool:
        """Return whether nothing is there, or a folder with at most the first file that a killed process did not
        finish.
        """
        if not self.path.exists():
            return not self.path.is_symlink()
        return self.path.is_dir() and all(p.name.endswith(UNFINISHED) and p.is_file() for p in self.path.iterdir())

    def obstacle(self) -> str | None:
        """Say whether there is a file in the way, or a folder around it that cannot be written."""
        if self.path.exists():
            return None if self.path.is_dir() else "is a file, not a Zarr store"
        parent = next(p for p in self.path.absolute().parents if p.exists())
        if parent.is_dir() and os.access(parent, os.W_OK | os.X_OK):
            return None
        return f"cannot make a store there: {parent} is not a directory that can be written"

    @contextmanager
    def tidied(self) -> Iterator[None]:
        """Remove folders that were not there before and are empty now."""
        missing = [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
        try:
            yield
        finally:
            with suppress(OSError):
                for folder in missing:
                    folder.rmdir()

    def _write(self, key: str, content: bytes, *, durable: bool) -> Path:
        path = self.path / key
        path.parent.mkdir(parents=True, exist_ok=True)
        with _finished(path, content, durable=durable) as temporary:
            temporary.replace(path)
        return path


@contextmanager
def _finished(path: Path, content: bytes, *, durable: bool) -> Iterator[Path]:
    """Give a file beside ``path`` with this content, which is gone afterwards unless it was renamed."""
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


def _create_directly(path: Path, content: bytes) -> bool:
    try:
        with path.open("xb") as file:
            file.write(content)
    except FileExistsError:
        return False
    return True


def _raise_unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error
