"""The names of the files of the dataset's chunks.

An array's chunks can have two sets of names, by two encodings of Zarr's specification, and each generation that changes
the array uses the set that the last one does not.  So the files of the last generation stay as they are until the root
document, replaced in one step, names those of the new one; a reader who opened the last one can read on until the
generation after next begins.
"""

import itertools
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

ENCODINGS = [{"name": name, "configuration": {"separator": "."}} for name in ("default", "v2")]


def chunk_keys(documents: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of all files of chunks of arrays, by their documents."""
    return [chunk_key(name, array, place) for name, array in documents.items() for place in chunk_places(array)]


def chunk_key(name: str, document: Mapping[str, Any], place: tuple[int, ...]) -> str:
    """Return the name of a chunk's file, as the array's document asks."""
    encoding = document["chunk_key_encoding"]
    parts = [str(number) for number in place]
    if encoding["name"] == "v2":
        return f"{name}/{encoding['configuration']['separator'].join(parts) or '0'}"
    return f"{name}/{encoding['configuration']['separator'].join(['c', *parts])}"


def chunk_places(document: Mapping[str, Any]) -> Iterator[tuple[int, ...]]:
    """Yield the places of all chunks of an array."""
    chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
    return itertools.product(*(range(-(-n // size)) for n, size in zip(document["shape"], chunk, strict=True)))


def leftovers(keys: Collection[str], documents: Collection[str]) -> set[str]:
    """Return the files of the dataset's arrays, and of arrays that it no longer has, among the names of all files."""
    folders: dict[str, set[str]] = {}
    for key in keys:
        folder, separator, _ = key.partition("/")
        if separator:
            folders.setdefault(folder, set()).add(key)
    chunk = re.compile(r"[^/]+/(c|c\.|\d)[\d.]*")
    known = {name for name in folders if name in documents or all(map(chunk.fullmatch, folders[name]))}
    return {key for name in known for key in folders[name]}


def encoding_of(document: Mapping[str, Any]) -> int:
    """Return which of the two sets of names an array's chunks have."""
    return int(document["chunk_key_encoding"]["name"] == "v2")
