"""Where a store is: a folder of this machine or a prefix in a bucket, with files that have names like ``a/b/c``.

Both can replace a file in one step, make one only if there is none (`create`), and replace one only if it has not
changed (`swap`); ledger, dataset and lock need nothing else.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Union

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.folder import Folder

if TYPE_CHECKING:
    from linksweep.sweep.stores.bucket import Bucket

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
