"""Records failed points by digest, so that a later run, a report or a retry knows of them."""

from collections.abc import Mapping
from typing import Any

FILE = "failures/zarr.json"
MAX_TRACEBACKS = 1000
TRACEBACK_BYTES = 4096
DIGEST_BYTES = 16

Record = dict[str, str]
"""The record of one point: place, kind, message, traceback, host, when."""


def as_json(failures: Mapping[bytes, Record]) -> dict[str, Record]:
    """Return failures as JSON holds them: digests in hexadecimal, the ends of the first `MAX_TRACEBACKS` tracebacks."""
    kept: dict[str, Record] = {}
    tracebacks = 0
    for digest, record in failures.items():
        text = record.get("traceback", "")
        tracebacks += bool(text)
        end = text.encode()[-TRACEBACK_BYTES:].decode(errors="ignore")  # the end says what was raised and where
        kept[digest.hex()] = record | {"traceback": end if tracebacks <= MAX_TRACEBACKS else ""}
    return kept


def read(attributes: Mapping[str, Any] | None) -> dict[bytes, Record]:
    """Return the failures that the attributes of a document record, none where there is none; raises ValueError."""
    recorded = {} if attributes is None else attributes.get("failures")
    if not isinstance(recorded, dict):
        raise ValueError("it is no record of failed points")
    try:
        failures = {bytes.fromhex(key): {str(k): str(v) for k, v in record.items()} for key, record in recorded.items()}
    except (AttributeError, ValueError) as error:
        raise ValueError(f"it is no record of failed points: {error}") from error
    if any(len(digest) != DIGEST_BYTES for digest in failures):
        raise ValueError("it is no record of failed points: a digest of another length")
    return failures
