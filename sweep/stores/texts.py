"""Stores the texts in results by the digests that stand for them in the ledger's rows, in documents of limited size."""

import re
from collections.abc import Mapping
from typing import Any

from linksweep.sweep.functions.values import text_digest
from linksweep.sweep.stores.checksums import noting
from linksweep.sweep.stores.ledger import Ledger
from linksweep.sweep.stores.location import Location

FOLDER = "blocks/texts"
MOST_BYTES = 2**20
"""Size from which on nothing is added to a document."""

_FILE = re.compile(rf"{FOLDER}/(\d+)/zarr\.json")


class Texts(dict[bytes, str]):
    """The texts of a store, by digest.  Those that `add` takes are durable after `flush`, and that of the ledger."""

    def __init__(self, location: Location, ledger: Ledger) -> None:
        """Read the documents of a ledger; a damaged one counts as missing."""
        super().__init__()
        self._ledger = ledger
        self._last: dict[str, str] = {}
        self._bytes = 0
        self._new = False
        self.damaged: dict[str, str] = {}
        numbers = {
            key: int(match[1]) for key in ledger.keys | ledger.documents.known.keys() if (match := _FILE.fullmatch(key))
        }
        for file, content in location.get_all(sorted(numbers)).items():
            with noting(self.damaged, file):
                self.update(_texts(ledger.documents.read(file, content) or {}))
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
            self._ledger.put(f"{FOLDER}/{self._number}/zarr.json", {"texts": self._last})
            self._new = False


def _texts(attributes: Mapping[str, Any]) -> dict[bytes, str]:
    """Return the texts in a document; raises ValueError where it holds something else."""
    told = attributes.get("texts")
    if not isinstance(told, dict):
        raise ValueError("it holds no texts")
    found = {bytes.fromhex(key): str(text) for key, text in told.items()}
    if any(text_digest(text) != digest for digest, text in found.items()):
        raise ValueError("it holds a text under the digest of another")
    return found
