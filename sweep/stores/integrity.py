"""What a store promises of its files: a damaged, exchanged, rolled-back or foreign one is found.

Every file that is read is named in a document with a checksum of its content; the two documents that are named nowhere,
the root and the manifest of the ledger, have a seal: a checksum of themselves with their name.  The manifest is
replaced in one step after everything else was written, and counts up; what it does not name is as if it had never been
written.  So a process that is killed at any instant leaves a ledger that is merely shorter.  The root has the manifest
of its own writing: that of the ledger can only be the same or a later one.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from linksweep.sweep.contract import MOST_VALUES, REFERENCE
from linksweep.sweep.contract.rows import KEY_BYTES

FORMAT = 7

ROOT, MANIFEST = "zarr.json", "blocks/zarr.json"

# Attributes of a sealed document: its checksum, which store it is of, and which writing.
SEAL, STORE, REVISION = "checksum", "store_id", "revision"

# The attribute of the root document with the manifest of the ledger at the time of writing.
LEDGER_THEN = "manifest"

# The attribute of the root document with the names of the files of all chunks of the dataset, and their checksums.
CHUNKS = "chunk_checksums"

ANOTHER = "it is whole, but of another writing or another store"
MISSING = "it is missing"

DEEPEST = 32  # lists and objects inside each other in a document; what linksweep writes has less than half

# The most bytes of a file of the ledger, unpacked.
MOST_BYTES = 2**31

# Types of the fields of a row of the ledger; the last two are text and references to chunks.
TYPES = ("<f8", "<i8", "|b1", "<M8[ns]", "|O", REFERENCE.str)


@contextmanager
def noting(damaged: dict[str, str], file: str) -> Iterator[None]:
    """Add a ``file`` to ``damaged`` and go on after an error that its content causes: one that is forged may be too
    large or too deep.
    """
    try:
        yield
    except (ValueError, LookupError, TypeError, ArithmeticError, MemoryError, RuntimeError) as error:
        damaged[file] = str(error) or type(error).__name__


def checksum(content: bytes) -> str:
    """Return the checksum of the content of a file."""
    return blake2b(content, digest_size=16).hexdigest()


def whole(content: bytes | None, expected: str) -> bytes:
    """Return the content of a file; raises ValueError where it is missing or another one than is expected."""
    if content is None or checksum(content) != expected:
        raise ValueError(MISSING if content is None else "its content is another one")
    return content


def whole_chunk(content: bytes | None, expected: str, is_text: bool = False) -> bytes:
    """Return the content of a chunk; raises ValueError as `whole`, and where more would be unpacked than is written."""
    chunk = whole(content, expected)
    # The header of a Zstandard frame, by RFC 8878: which fields there are, and the size.
    flags = int.from_bytes(chunk[4:5])
    start, length = 5 + (not flags & 32) + (0, 1, 2, 4)[flags & 3], (flags >> 5 & 1, 2, 4, 8)[flags >> 6]
    size = int.from_bytes(chunk[start : start + length], "little") + 256 * (length == 2)
    if not 0 < size <= (MOST_BYTES if is_text else 8 * MOST_VALUES):
        raise ValueError("more would be unpacked from it than is written")
    return chunk


def sealed(document: Mapping[str, Any], file: str) -> bytes:
    """Return a document, with its checksum, as it is stored in a file of this name."""
    # What a reader will see: keys are texts, tuples are lists.
    plain = json.loads(json.dumps(document))
    plain["attributes"].pop(SEAL, None)
    plain["attributes"][SEAL] = _digest(file, plain)
    return json.dumps(plain).encode()


def unsealed(content: bytes | None, file: str) -> dict[str, Any]:
    """Return the document that was stored in a file of this name; raises ValueError where it is missing, no JSON, or
    not what was stored there.
    """
    if content is None:
        raise ValueError(MISSING)
    try:
        document: dict[str, Any] = json.loads(content)
        seal = document["attributes"].pop(SEAL)
        same = seal == _digest(file, document)
    except (RecursionError, TypeError, KeyError, AttributeError) as error:
        raise ValueError("it has no checksum, or is nested too deeply") from error
    if not same:
        raise ValueError("its checksum does not match its content and name")
    document["attributes"][SEAL] = seal
    return document


def group_document(attributes: Mapping[str, Any], arrays: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the document of a Zarr group, with a copy of those of its ``arrays``."""
    copies = {"kind": "inline", "must_understand": False, "metadata": dict(arrays or {})}
    more = {} if arrays is None else {"consolidated_metadata": copies}
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)} | more


def _digest(file: str, document: Mapping[str, Any]) -> str:
    return checksum(f"{file}\n{json.dumps(document, sort_keys=True)}".encode())


# What the documents may say: every field that is read, with its type and its limits.  A store may come from a stranger,
# and a checksum can be forged; nothing else needs to look twice at what it has read.


def _flat_enough(document: Any) -> Any:
    """Return a document; raises ValueError for one that readers, which go down by recursion, might not get through."""
    level = [document]
    for _ in range(DEEPEST):
        if not level:
            return document
        inner = [one.values() if isinstance(one, dict) else one for one in level]
        level = [value for values in inner for value in values if type(value) in (dict, list)]
    raise ValueError("it is nested too deeply")


def _said(text: Any) -> Any:
    """Return what JSON says; pydantic's own reader refuses names of files that are not UTF-8, as Python has them."""
    try:
        return json.loads(text)
    except (TypeError, RecursionError) as error:
        raise ValueError("it is no JSON, or nested too deeply") from error


Kind = TypeVar("Kind")
Json = Annotated[Kind, BeforeValidator(_said)]
Model = TypeVar("Model", bound=BaseModel)
Count = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[int, Field(gt=0, lt=2**48)]
Object = Annotated[dict[str, Any], AfterValidator(_flat_enough)]
Texts = dict[str, str]
Name = Annotated[str, Field(pattern=r"^[^/]+$", max_length=255)]
FileName = Annotated[str, Field(pattern=r"^[a-z]+\.\d{1,18}\.\d{1,9}$")]
ChunkName = Annotated[str, Field(pattern=r"^[^/.][^/]*/(c|c\.|\d)[\d.]*$", max_length=512)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]


def row_type(row: Sequence[Any]) -> np.dtype[np.void]:
    """Return the type of rows that a manifest tells; raises ValueError for any other than linksweep writes."""
    fields: list[Any] = []
    for name, kind, *shape in row:
        if isinstance(kind, list) and not (inner := row_type(kind)).hasobject:
            fields.append((str(name), inner))
        elif kind in TYPES and all(isinstance(n, int) and n >= 0 for sizes in shape for n in sizes):
            fields.append((str(name), kind, *map(tuple, shape)))
        else:
            raise ValueError("its rows have another type")
    return np.dtype(fields)


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, defer_build=True)


class _Written(BaseModel):
    # Forbids what a newer version may add: such a manifest must not be continued as if that had no meaning.
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class File(_Written):
    """A file of the ledger: its name in the folder of the ledger, its checksum, and how long it is unpacked."""

    name: FileName
    checksum: str
    size: Annotated[int, Field(ge=0, lt=MOST_BYTES)]


class LedgerPart(_Written):
    """Rows that were written together: how many, their file, and that of their samples if these are kept."""

    records: Annotated[int, Field(ge=0, lt=2**28)]
    rows: File
    samples: File | None = None

    @property
    def files(self) -> list[File]:
        """The files of this part."""
        return [self.rows] if self.samples is None else [self.rows, self.samples]


class Manifest(_Written):
    """What counts of the ledger of a ``store``: the type of its rows, the floats of a kept realisation, its parts, and
    its documents by their kind.
    """

    store: str
    revision: Count = 0
    row: list[Any] = []
    samples_width: Annotated[int, Field(ge=0, lt=2**28)] = 0
    parts: list[LedgerPart] = []
    documents: dict[Literal["failures", "study"], File] = {}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        try:
            width = KEY_BYTES + row_type(self.row).itemsize  # with 8 bytes for a text, which has 4 or more in the file
        except (TypeError, RecursionError) as error:
            raise ValueError("its rows have another type") from error
        if any(part.records * width > 4 * part.rows.size for part in self.parts):
            raise ValueError("it has more records than are in its files")
        return self

    def sealed(self) -> bytes:
        """Return the content of the file `MANIFEST`."""
        return sealed(group_document({"manifest": self.model_dump()}), MANIFEST)


class Failures(_Part):
    """The document of failed points: the record of each by its digest in hexadecimal."""

    failures: dict[Digest, Texts]


def read_manifest(content: bytes | None) -> Manifest:
    """Return the manifest in a ledger's file; raises ValueError where it is missing or damaged."""
    return checked(Manifest, unsealed(content, MANIFEST)["attributes"].get("manifest"))


def newest(content: bytes | None, of_root: Manifest) -> Manifest:
    """Return the manifest in a ledger's file; raises ValueError where it is damaged, or older than that ``of_root``."""
    if content is None and not of_root.revision:
        # A run that has just begun.
        return of_root
    manifest = read_manifest(content)
    # The root has the manifest of its own writing; after that the ledger only grows.
    is_older = manifest.revision <= of_root.revision and manifest != of_root
    if is_older or manifest.store != of_root.store:
        raise ValueError(ANOTHER)
    return manifest


class _Codec(_Part):
    name: Literal["bytes", "vlen-utf8", "zstd", "crc32c"]


class _Plain(_Part):
    # Arrays of Zarr 2 may have filters that unpickle.
    zarr_format: Literal[3]
    codecs: list[_Codec]


class Tables(_Part):
    """The root document of a store that is one dataset, as `sweep tie` writes it."""

    arrays: Annotated[dict[Name, _Plain], Field(validation_alias=AliasPath("consolidated_metadata", "metadata"))]


class _Array(_Plain):
    shape: list[Count]
    grid: Annotated[Literal["regular"], Field(validation_alias=AliasPath("chunk_grid", "name"))]
    sizes: Annotated[list[Size], Field(validation_alias=AliasPath("chunk_grid", "configuration", "chunk_shape"))]
    dimension_names: list[Name] = []
    attributes: Object
    coordinates: Annotated[str, Field(validation_alias=AliasPath("attributes", "coordinates"))] = ""
    symbols: Annotated[Json[Texts], Field(validation_alias=AliasPath("attributes", "symbols"))] = {}

    @property
    def chunks(self) -> int:
        """How many chunks there are; raises ValueError where there cannot be such chunks."""
        if (
            len({len(self.shape), len(self.sizes), len(self.dimension_names)}) > 1
            or math.prod(self.sizes) > MOST_VALUES
            or [codec.name for codec in self.codecs[1:]] != ["zstd", "crc32c"]
        ):
            raise ValueError("an array with such chunks is never written")
        return math.prod(-(-n // size) for n, size in zip(self.shape, self.sizes, strict=True))


class _Layout(_Part):
    fields: list[Object]
    coordinates: list[Object]


class _Function(_Part):
    outputs: list[Object]
    layout: _Layout | None


class _Record(_Part):
    name: str
    parameters: list[Object]
    outputs: list[Object]
    sample_outputs: list[Object]
    function: _Function | None = None


class _Meaning(_Part):
    fixed: Object


class _Points(_Part):
    parameters: list[str]


class _Code(_Part):
    first_row: Count
    code: Texts


class Attributes(_Part, extra="allow"):
    """The attributes of a root document; those that are not named here are texts."""

    __pydantic_extra__: Texts
    linksweep_format: int
    store_id: str
    generation: Count
    complete: Literal[0, 1] = 0
    study_meaning: Json[_Meaning]
    study_axes: Json[list[str]]
    manifest: Json[Manifest] = Manifest(store="")
    chunk_checksums: Json[dict[ChunkName, str]] = {}
    experiment_record: Json[_Record] | None = None
    study_document: Json[Object] | None = None
    merged: Json[list[Object]] = []
    code: Json[list[_Code]] = []
    point_table: Json[_Points] | None = None
    failures: Json[Texts] = {}
    warnings: Json[list[str]] = []
    versions: Json[Object] = {}
    claims: Json[list[Object]] = []
    conclusion: Json[Object] | None = None
    shared_axes: Json[list[str]] = []
    citation: Json[list[str]] = []
    part: Annotated[str, Field(pattern=r"^[1-9]\d{0,5}/[1-9]\d{0,5}$")] | None = None
    seed: int = 0
    n_sim: Size = 1
    n_cat: Size = 1
    precision: Annotated[float, Field(gt=0)] = 1
    points: Count = 0
    points_done: Count = 0
    blocks: Count = 0
    repaired: Literal[0, 1] = 0
    error_convention: Count = 0
    common_random_numbers: Literal[0, 1] = 0


class Root(_Part):
    """A root document."""

    attributes: Attributes
    arrays: Annotated[dict[Name, _Array], Field(validation_alias=AliasPath("consolidated_metadata", "metadata"))]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        # An array of which chunks are not listed would be read as empty there, however large it says that it is.
        listed = Counter(file.partition("/")[0] for file in self.attributes.chunk_checksums)
        expected = {name: array.chunks for name, array in self.arrays.items()}
        if listed != Counter(expected):
            raise ValueError("it has other checksums than chunks")
        coordinates = {n for a in self.arrays.values() for n in (*a.dimension_names, *a.coordinates.split())}
        axes = set(self.arrays["status"].dimension_names if "status" in self.arrays else ())
        if other := [n for n in self.arrays.keys() - coordinates if not axes <= {*self.arrays[n].dimension_names}]:
            raise ValueError(f"{other[0]} has other axes than the status")
        return self


def checked(kind: type[Model], document: Any) -> Model:
    """Return a document of this kind; raises ValueError that names the first field which is wrong."""
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}" if where else first["msg"]) from error
