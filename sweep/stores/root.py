"""The root document, which says what a store means, and its copy in the ledger in case the root is damaged."""

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.checksums import SEAL, unsealed
from linksweep.sweep.stores.document import check_attributes, check_root
from linksweep.sweep.stores.location import Location, reading
from linksweep.sweep.stores.manifest import REVISION, STORE, Manifest

FORMAT = 4

LEDGER_THEN = "manifest"
"""The attribute with the manifest of the ledger at the time of writing."""

ROOT, COPY = "zarr.json", "blocks/zarr.json"

REPAIR = "`sweep check {} --repair` repairs what can be repaired"
MARKS = (b"linksweep_format", b"study_meaning", b"study_digest")
"""Words by which a document of a store can be recognised even if it is damaged."""


def read_root(location: Location) -> dict[str, Any]:
    """Return the root document; raises SweepError unless a whole linksweep store of a known format is there."""
    root = find_root(location)
    if root is None:
        raise SweepError("no store there", str(location))
    return root


def find_root(location: Location) -> dict[str, Any] | None:
    """Return the root document, None where nothing is; raises SweepError as `read_root`."""
    where = str(location)
    with reading(location):
        location.require_plain()
        content = location.get(ROOT)
        if content is None:
            if location.is_free():
                return None
            if obstacle := location.obstacle():
                raise SweepError(obstacle, where)
        try:
            root = unsealed(content, ROOT)
            check_format(root["attributes"], where)
            check_root(root)
            return root
        except (ValueError, KeyError) as error:
            if readable_copy(location) is not None:
                problem = "it is another document" if isinstance(error, KeyError) else error
                raise SweepError(f"{ROOT} is damaged ({problem}); {REPAIR.format(where)}", where) from error
            _refuse_other_formats(content or b"", where)
            raise SweepError(_without_meaning(location, content or b""), where) from error


def _without_meaning(location: Location, content: bytes) -> str:
    """Say what a place is that has neither a whole root document nor a copy of one."""
    lost = "so that nothing tells what the numbers mean; bring one back from a backup, or run the study into a new"
    if location.get("blocks/index/zarr.json") is not None or location.get(COPY) is not None:
        return f"{ROOT} and its copy {COPY} are both damaged, {lost} store with -o"
    if any(mark in content for mark in MARKS):
        return f"{ROOT} is damaged and has no copy yet, {lost} store with -o; no results were in it"
    return "is not a store of linksweep (foreign or half-made); nothing was changed"


def check_format(attributes: Mapping[str, Any], where: str) -> None:
    """Raise SweepError for a store of a format that this version does not read; KeyError for what is no store."""
    version = attributes["linksweep_format"]
    if version != FORMAT:
        age = "newer: upgrade with `pip install -U linksweep`" if isinstance(version, int) and version > FORMAT else ""
        age = age or "older, from before the first release: run the study into a new store with -o"
        raise SweepError(
            f"has store format {version}; this version of linksweep reads format {FORMAT}. It is {age}",
            where,
        )


def manifest_of(root: Mapping[str, Any]) -> Manifest:
    """Return what the ledger held when a root document was written."""
    attributes = root["attributes"]
    if LEDGER_THEN not in attributes:
        return Manifest(store=attributes[STORE])
    return Manifest.model_validate_json(attributes[LEDGER_THEN])


def is_new(root: Mapping[str, Any]) -> bool:
    """Return whether no results were written to a store yet: a run has just begun, or ended in its first moment."""
    return not root["attributes"].get("generation")


def readable_copy(location: Location) -> dict[str, Any] | None:
    """Return the ledger's copy of a store's attributes; None where it is missing, damaged or of another format."""
    try:
        attributes = unsealed(location.get(COPY), COPY)["attributes"]
        check_attributes(attributes)
    except ValueError:
        return None
    attributes = {key: value for key, value in attributes.items() if key not in (SEAL, REVISION)}
    return attributes if attributes.get("linksweep_format") == FORMAT else None


def copied(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that the ledger's copy has: all but those about one writing."""
    left_out = ("failures", "generation", "blocks", "chunk_checksums", LEDGER_THEN, SEAL)
    return {key: value for key, value in attributes.items() if key not in left_out}


def _refuse_other_formats(content: bytes, where: str) -> None:
    """Raise SweepError for a document of another format, which may have its checksum elsewhere."""
    with suppress(ValueError, KeyError, TypeError):
        attributes = json.loads(content)["attributes"]
        if isinstance(attributes["linksweep_format"], int):
            check_format(attributes, where)
