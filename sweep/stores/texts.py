"""Stores the texts in results by the digests that stand for them in the ledger's rows, in documents of limited size."""

import re
from collections.abc import Collection, Mapping

from sweep.functions.values import text_digest
from sweep.stores.checksums import group_document, noting, sealed, unsealed
from sweep.stores.location import Location

FOLDER = "blocks/texts"
MOST_BYTES = 2**20
"""Size from which on nothing is added to a document."""

_FILE = re.compile(rf"{FOLDER}/(\d+)/zarr\.json")


class Texts(dict[bytes, str]):
    """The texts of a store, by digest.  Those that `add` takes are durable after `flush`."""

    def __init__(self, location: Location, keys: Collection[str]) -> None:
        """Read the documents among ``keys``, the names of all files of the store; a damaged one counts as missing."""
        super().__init__()
        self._location = location
        self._last: dict[str, str] = {}
        self._bytes = 0
        self._new = False
        self.damaged: dict[str, str] = {}
        numbers = {key: int(match[1]) for key in sorted(keys) if (match := _FILE.fullmatch(key))}
        for file, content in location.get_all(numbers).items():
            with noting(self.damaged, file):
                self.update(read(content, file))
        self._number = 1 + max(numbers.values(), default=-1)

    def add(self, texts: Mapping[bytes, str]) -> None:
        """Add the texts that are not there yet."""
        for digest, text in texts.items():
            if digest not in self:
                if self._bytes > MOST_BYTES:
                    self.flush()
                    self._number += 1
                    self._last, self._bytes = {}, 0
                self[digest] = self._last[digest.hex()] = text
                self._bytes += 4 * len(text) + 40
                self._new = True

    def flush(self) -> None:
        """Write what is new."""
        if self._new:
            file = f"{FOLDER}/{self._number}/zarr.json"
            self._location.put(file, sealed(group_document({"texts": self._last}), file))
            self._new = False


def read(content: bytes | None, file: str) -> dict[bytes, str]:
    """Return the texts in a document; raises ValueError where it is damaged or holds something else."""
    told = unsealed(content, file)["attributes"].get("texts")
    if not isinstance(told, dict):
        raise ValueError("it holds no texts")
    found = {bytes.fromhex(key): str(text) for key, text in told.items()}
    if any(text_digest(text) != digest for digest, text in found.items()):
        raise ValueError("it holds a text under the digest of another")
    return found
