"""Zarr's JSON documents with a checksum of their own among the attributes: a flipped bit must not change what a store
means.
"""

import json
from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

SEAL = "checksum"


def sealed(document: Mapping[str, Any]) -> bytes:
    """Return a document, with its checksum, as it is stored."""
    plain = json.loads(json.dumps(document))
    plain["attributes"].pop(SEAL, None)
    plain["attributes"][SEAL] = _digest(plain)
    return json.dumps(plain).encode()


def unsealed(content: bytes | None) -> dict[str, Any]:
    """Return a stored document; raises ValueError where it is missing, no JSON, or not what was sealed."""
    if content is None:
        raise ValueError("it is missing")
    document = json.loads(content)
    try:
        seal = document["attributes"].pop(SEAL)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError("it has no checksum") from error
    if seal != _digest(document):
        raise ValueError("its checksum does not match")
    document["attributes"][SEAL] = seal
    return dict(document)


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)}


def _digest(document: Mapping[str, Any]) -> str:
    return blake2b(json.dumps(document, sort_keys=True).encode(), digest_size=8).hexdigest()
