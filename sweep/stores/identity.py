"""What a store's numbers mean, as its root document says it."""

import json
from collections.abc import Mapping
from typing import Any

from sweep.stores.ledger import shapes_of
from sweep.stores.root import FORMAT
from sweep.studies.study import Study
from sweep.tablefile import content_digest


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes by which a store knows what its numbers mean and how its ledger is laid out."""
    return {
        "linksweep_format": FORMAT,
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
        "ledger": json.dumps(shapes_of(study.experiment, keep_samples=study.keeps_samples)),
    }


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
