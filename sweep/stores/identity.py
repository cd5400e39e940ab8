"""What a store's numbers mean: told by the root document and, in case that is damaged, by that of the ledger."""

import json
from collections.abc import Mapping
from typing import Any

from sweep.contract import SweepError
from sweep.stores.checksums import unsealed
from sweep.stores.ledger import shapes_of
from sweep.stores.location import Location, reading
from sweep.studies.study import Study
from sweep.tablefile import content_digest

FORMAT = 2
ROOT, COPY = "zarr.json", "blocks/zarr.json"

REPAIR = "`sweep repair {}` sets right what can be"


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes by which a store knows what its numbers mean and how its ledger is laid out."""
    return {
        "linksweep_format": FORMAT,
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
        "ledger": json.dumps(shapes_of(study.experiment, keep_samples=study.sampling.keep_samples)),
    }


def read_root(location: Location) -> dict[str, Any]:
    """Return the root document; raises SweepError unless a whole linksweep store of this format is there."""
    root = find_root(location)
    if root is None:
        raise SweepError("no store there", str(location))
    return root


def find_root(location: Location) -> dict[str, Any] | None:
    """Return the root document, None where nothing is; raises SweepError as `read_root`."""
    where = str(location)
    with reading(location):
        content = location.get(ROOT)
        if content is None:
            if location.is_free():
                return None
            if obstacle := location.obstacle():
                raise SweepError(obstacle, where)
        try:
            root = unsealed(content)
            check_format(root["attributes"], where)
            return root
        except (ValueError, KeyError) as error:
            if readable_copy(location) is None:
                _refuse_other_formats(content or b"", where)
                message = "is not a store of linksweep (foreign or half-made); nothing was changed"
                if location.get("blocks/index/zarr.json") is not None:
                    message = (
                        f"{ROOT} and its copy {COPY} are both damaged, so that nothing tells what the numbers mean; "
                        "bring one back from a backup, or run the study into a new store with -o"
                    )
                raise SweepError(message, where) from error
            raise SweepError(f"{ROOT} is damaged ({error}); {REPAIR.format(where)}", where) from error


def check_format(attributes: Mapping[str, Any], where: str) -> None:
    """Raise SweepError for a store of another format than this version writes; KeyError for what is no store."""
    version = attributes["linksweep_format"]
    if version != FORMAT:
        age = "newer: upgrade with `pip install -U linksweep`" if isinstance(version, int) and version > FORMAT else ""
        age = age or "older, from before the first release: run the study into a new store with -o"
        raise SweepError(
            f"has store format {version}; this version of linksweep reads format {FORMAT}. It is {age}", where
        )


def readable_copy(location: Location) -> dict[str, Any] | None:
    """Return the ledger's copy of a store's attributes; None where it is missing, damaged or of another format."""
    try:
        attributes = unsealed(location.get(COPY))["attributes"]
    except ValueError:
        return None
    return dict(attributes) if attributes.get("linksweep_format") == FORMAT else None


def damaged_copy(content: bytes | None) -> dict[str, str]:
    """Return what is wrong with the ledger's copy, nothing where it was not written yet."""
    try:
        if content is not None:
            unsealed(content)
        return {}
    except ValueError as error:
        return {COPY: str(error)}


def _refuse_other_formats(content: bytes, where: str) -> None:
    """Raise SweepError for a document of another format, which may have its checksum elsewhere."""
    try:
        attributes = json.loads(content)["attributes"]
        if isinstance(attributes["linksweep_format"], int):
            check_format(attributes, where)
    except (ValueError, KeyError, TypeError):
        return


def differences(attributes: Mapping[str, Any], study: Study) -> list[str]:
    """Say in what the meaning of stored results differs from a study's; values of what is an axis in either do not."""
    old, new = json.loads(attributes["study_meaning"]), json.loads(identity(study)["study_meaning"])
    axes = {*json.loads(attributes["study_axes"]), *study.axes}
    defaults = json.loads(json.dumps(study.experiment.defaults(), default=content_digest))
    pairs = [(key, old.get(key, "absent"), new.get(key, "absent")) for key in sorted({*old, *new} - {"fixed"})]
    pairs += [
        (f"fixed.{name}", old["fixed"].get(name, defaults.get(name)), new["fixed"].get(name, defaults.get(name)))
        for name in sorted({*old["fixed"], *new["fixed"]} - axes)
    ]
    return [f"{key}: {was!r} in the store, {now!r} in the study" for key, was, now in pairs if was != now]
