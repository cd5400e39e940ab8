"""What the root document of a store may say: every field that is read, with its type and its limits, in one place.

A store may come from a stranger, and a checksum can be forged; nothing else needs to look twice at what it has read.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, Json, ValidationError, model_validator

from linksweep.sweep.stores.manifest import Count, Manifest

INDEX_BYTES = 40
"""Bytes in a row of the index."""

MOST_VALUES = 2**20
"""The most values of a chunk of results: more are never written."""

MOST_BYTES = 2**31
"""The most bytes of a chunk of the ledger."""

Size = Annotated[int, Field(gt=0, lt=2**48)]
Width = Annotated[int, Field(ge=0, lt=2**31)]
Object = dict[str, Any]
Texts = dict[str, str]
Name = Annotated[str, Field(pattern=r"^[^/]+$", max_length=255)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True)


class _Chunks(_Part):
    chunk_shape: list[Size]


class _Grid(_Part):
    name: Literal["regular"]
    configuration: _Chunks


class _Separator(_Part):
    separator: Literal["."]


class _Encoding(_Part):
    name: Literal["default", "v2"]
    configuration: _Separator


class _Codec(_Part):
    name: Literal["bytes", "vlen-utf8", "zstd", "crc32c"]


class _Array(_Part):
    shape: list[Count]
    chunk_grid: _Grid
    chunk_key_encoding: _Encoding
    codecs: list[_Codec]
    dimension_names: list[Name] = []
    attributes: Object

    @property
    def chunks(self) -> int:
        """How many chunks there are; raises ValueError where there cannot be such chunks."""
        sizes = self.chunk_grid.configuration.chunk_shape
        if len({len(self.shape), len(sizes), len(self.dimension_names)}) > 1 or math.prod(sizes) > MOST_VALUES:
            raise ValueError("an array with such chunks is never written")
        return math.prod(-(-n // size) for n, size in zip(self.shape, sizes, strict=True))


class _Arrays(_Part):
    metadata: dict[Name, _Array]


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


class _Attributes(_Part):
    store_id: str
    generation: Count
    complete: Literal[0, 1] = 0
    ledger: Json[dict[str, Annotated[list[Width], Field(min_length=2, max_length=2)]]]
    study_meaning: Json[_Meaning]
    study_axes: Json[list[str]]
    manifest: Json[Manifest] = Manifest(store="")
    chunk_checksums: Json[dict[Name, list[str]]] = {}
    experiment_record: Json[_Record] | None = None
    study_document: Json[Object] | None = None
    merged: Json[list[Object]] = []
    code: Json[list[_Code]] = []
    point_table: Json[_Points] | None = None
    failures: Json[Texts] = {}
    warnings: Json[list[str]] = []
    versions: Json[Object] = {}
    defined: Json[dict[str, Texts]] = {}
    claims: Json[list[Object]] = []
    conclusion: Json[Object] | None = None
    shared_axes: Json[list[str]] = []
    citation: Json[list[str]] = []
    title: str = ""
    study: str = ""
    study_name: str = ""
    study_digest: str = ""
    study_overrides: str = ""
    started: str = ""
    finished: str = ""
    experiment: str = ""
    function: str = ""
    seed: int = 0
    n_sim: Size = 1
    n_cat: Size = 1
    precision: Annotated[float, Field(gt=0)] = 1
    points: Count = 0
    points_done: Count = 0
    blocks: Count = 0
    error_convention: Count = 0
    common_random_numbers: Literal[0, 1] = 0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        shapes = self.ledger
        if not {"index", "sums"} <= shapes.keys() <= {"index", "sums", "samples"} or shapes["index"][1] != INDEX_BYTES:
            raise ValueError("its ledger has another layout")
        if any(rows == 0 or 8 * rows * width > MOST_BYTES for rows, width in shapes.values()):
            raise ValueError("chunks of its ledger are too large")
        self.manifest.check(shapes)
        return self


class _Root(_Part):
    attributes: _Attributes
    consolidated_metadata: _Arrays

    @model_validator(mode="after")
    def _fits(self) -> Self:
        arrays, checksums = self.consolidated_metadata.metadata, self.attributes.chunk_checksums
        if {name: array.chunks for name, array in arrays.items()} != {n: len(found) for n, found in checksums.items()}:
            raise ValueError("it has other checksums than chunks")
        return self


def check_root(document: Mapping[str, Any]) -> None:
    """Raise ValueError, which names the first field, for a root document that linksweep does not write."""
    _check(_Root, document)


def check_attributes(attributes: Mapping[str, Any]) -> None:
    """Raise ValueError for attributes of a root document that linksweep does not write."""
    _check(_Attributes, {**attributes, "generation": 0})


def _check(kind: type[BaseModel], found: Any) -> None:
    try:
        kind.model_validate(found)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}" if where else first["msg"]) from error
