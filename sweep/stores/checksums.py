"""Zarr's JSON documents with a checksum of their own among the attributes, bound to the name of the file: neither a
flipped bit nor an exchange of files must change what a store means.
"""

import json
from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

SEAL = "checksum"
BYTES = 16
BYTES_UNBOUND = 8
"""Of the checksums of store format 2, which knew nothing of the name of the file."""


def sealed(document: Mapping[str, Any], file: str) -> bytes:
    """Return a document, with its checksum, as it is stored in a file of this name."""
    plain = json.loads(json.dumps(document))
    plain["attributes"].pop(SEAL, None)
    plain["attributes"][SEAL] = _digest(plain, file)
    return json.dumps(plain).encode()


def unsealed(content: bytes | None, file: str) -> dict[str, Any]:
    """Return the document that was stored in a file of this name; raises ValueError where it is missing, no JSON, or
    not what was stored there.
    """
    if content is None:
        raise ValueError("it is missing")
    document = json.loads(content)
    try:
        seal = document["attributes"].pop(SEAL)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError("it has no checksum") from error
    if seal not in (_digest(document, file), _unbound_digest(document)):
        raise ValueError("its checksum does not match its content and name")
    document["attributes"][SEAL] = seal
    return dict(document)


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def content_checksum(content: bytes) -> str:
    """Return what tells the content of a file from any other."""
    return blake2b(content, digest_size=BYTES).hexdigest()


def _digest(document: Mapping[str, Any], file: str) -> str:
    return blake2b(f"{file}\n{_as_text(document)}".encode(), digest_size=BYTES).hexdigest()


def _unbound_digest(document: Mapping[str, Any]) -> str:
    return blake2b(_as_text(document).encode(), digest_size=BYTES_UNBOUND).hexdigest()


def _as_text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, sort_keys=True)
