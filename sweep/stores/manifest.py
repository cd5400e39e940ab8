"""The manifest of a ledger: how many rows each of its arrays has, with a checksum of those in each chunk, and which
writing of each of its documents counts.

It is replaced in one step after everything else was written, and counts up; what is not in it is as if it had never
been written.  So a process that is killed at any instant leaves a ledger that is merely shorter, and any file that is
lost, cut, exchanged or of an earlier writing is found.  The root document holds the manifest of its own writing: that
of the ledger can only be the same or a later one.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from linksweep.sweep.stores.checksums import group_document, sealed, unsealed
from linksweep.sweep.stores.location import Location

MANIFEST = "blocks/manifest/zarr.json"
REVISION = "revision"
"""The attribute of a document that counts its writings."""

STORE = "store_id"
"""The attribute of a document that says which store it is of: not one that was there before, or a copy's."""

ANOTHER = "it is whole, but of another writing or another store"

Count = Annotated[int, Field(ge=0, lt=2**63)]


class Part(BaseModel):
    """The rows of an array that count, and the checksum of those in each of its chunks."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    rows: Count = 0
    chunks: list[str] = []


class Manifest(BaseModel):
    """What counts of the ledger of a ``store``: its arrays by name, and the writing of each document by file."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    store: str
    revision: Count = 0
    columns: dict[str, Part] = {}
    documents: dict[str, Count] = {}

    def sealed(self) -> bytes:
        """Return the content of the file `MANIFEST`."""
        return sealed(group_document({"manifest": self.model_dump()}), MANIFEST)

    def check(self, shapes: Mapping[str, Sequence[int]]) -> None:
        """Raise ValueError unless it fits a ledger with chunks of these rows and widths."""
        parts = [(part, shapes[name][0]) for name, part in self.columns.items() if name in shapes]
        rows = {self.columns.get(name, Part()).rows for name in ("index", "sums")}
        fits = len(parts) == len(self.columns) and len(rows) < 2
        if not fits or any(len(part.chunks) != -(-part.rows // size) for part, size in parts):
            raise ValueError("it does not fit the ledger")


def newest(content: bytes | None, of_root: Manifest, shapes: Mapping[str, Sequence[int]]) -> Manifest:
    """Return the manifest in a ledger's file; raises ValueError where it is damaged, or older than that ``of_root``."""
    if content is None and not of_root.revision:
        return of_root  # a run that has just begun
    try:
        found = Manifest.model_validate(unsealed(content, MANIFEST)["attributes"].get("manifest"))
    except ValidationError as error:
        raise ValueError("it is no manifest of a ledger") from error
    found.check(shapes)
    if found != of_root and (found.revision <= of_root.revision or found.store != of_root.store):
        raise ValueError(ANOTHER)
    return found


class Documents:
    """The documents of a ledger, each with a number that grows with each writing of it."""

    def __init__(self, location: Location, manifest: Manifest) -> None:
        """Start with those that a manifest knows."""
        self._location, self._store = location, manifest.store
        self.known = dict(manifest.documents)

    def read(self, file: str, content: bytes | None) -> dict[str, Any] | None:
        """Return the attributes of a document, None where there never was one; raises ValueError where it is damaged or
        of an earlier writing.

        One of a later writing is that of a run that was killed before it wrote the manifest.
        """
        if content is None and file not in self.known:
            return None
        attributes: dict[str, Any] = unsealed(content, file)["attributes"]
        self.known[file] = checked_revision(attributes, self._store, self.known.get(file, 1))
        return attributes

    def put(self, file: str, attributes: Mapping[str, Any]) -> None:
        """Replace a document; it counts from the next writing of the manifest on."""
        revision = self.known.get(file, 0) + 1
        self._location.put(file, sealed(group_document({**attributes, STORE: self._store, REVISION: revision}), file))
        self.known[file] = revision


def checked_revision(attributes: Mapping[str, Any], store: str, least: int) -> int:
    """Return the writing that a document is of; raises ValueError for another store's, and for one before ``least``."""
    revision = attributes.get(REVISION)
    if type(revision) is not int or not least <= revision < 2**63 or attributes.get(STORE) != store:
        raise ValueError(ANOTHER)
    return revision
