"""Where a store is: a folder of this machine or a prefix in a bucket, as whole files with names like ``a/b/c``.

Both replace a file in one step, make one only if there is none (`create`), and replace one only if it is still what
it was (`swap`); ledger, dataset and lock need nothing else.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Protocol

from sweep.contract import SweepError
from sweep.stores.folder import Folder


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
    """Return the place that an address or path names; raises SweepError for an address of no known kind,
    and for a bucket where obstore is not installed.
    """
    if not isinstance(where, str | Path):
        return where
    address = str(where)
    if address.startswith("s3:/"):  # pathlib makes one slash of two
        try:
            from sweep.stores.bucket import bucket_at
        except ImportError as error:
            raise SweepError(
                f"stores in a bucket need obstore: pip install 'linksweep[s3]' ({error})", address
            ) from error
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
