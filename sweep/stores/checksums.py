"""Puts a checksum, of the content and the name of the file, among the attributes of Zarr's JSON documents: neither a
flipped bit nor an exchange of files may change what a store means.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import blake2b
from typing import Any

SEAL = "checksum"
BYTES = 16


class DamagedError(ValueError):
    """Files that are not what was written; ``files`` maps their names to what is wrong."""

    def __init__(self, files: dict[str, str]) -> None:
        super().__init__("; ".join(f"{file}: {problem}" for file, problem in files.items()))
        self.files = files


@contextmanager
def noting(damaged: dict[str, str], file: str | None = None) -> Iterator[None]:
    """Go on after a DamagedError, whose files are added to ``damaged``, and after an error that the content of ``file``
    causes: one that is forged may be too large or too deep.
    """
    try:
        yield
    except DamagedError as error:
        damaged.update(error.files)
    except (ValueError, ArithmeticError, MemoryError, RecursionError) as error:
        if file is None:
            raise
        damaged[file] = str(error) or type(error).__name__


def sealed(document: Mapping[str, Any], file: str) -> bytes:
    """Return a document, with its checksum, as it is stored in a file of this name."""
    plain = json.loads(json.dumps(document))
    plain["attributes"].pop(SEAL, None)
    plain["attributes"][SEAL] = _digest(f"{file}\n", plain)
    return json.dumps(plain).encode()


def unsealed(content: bytes | None, file: str) -> dict[str, Any]:
    """Return the document that was stored in a file of this name; raises ValueError where it is missing, no JSON, or
    not what was stored there.
    """
    if content is None:
        raise ValueError("it is missing")
    try:
        document = json.loads(content)
        seal = document["attributes"].pop(SEAL)
        same = seal == _digest(f"{file}\n", document)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError("it has no checksum") from error
    if not same:
        raise ValueError("its checksum does not match its content and name")
    document["attributes"][SEAL] = seal
    return dict(document)


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def content_checksum(content: bytes) -> str:
    """Return the checksum of the content of a file."""
    return blake2b(content, digest_size=BYTES).hexdigest()


def _digest(before: str, document: Mapping[str, Any]) -> str:
    return content_checksum(f"{before}{json.dumps(document, sort_keys=True)}".encode())
