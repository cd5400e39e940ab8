"""Describes and compares what a store's numbers mean, in the terms of its root document."""

import json
from collections.abc import Mapping
from typing import Any

from linksweep.sweep.contract import Named
from linksweep.sweep.stores.ledger_arrays import shapes_of
from linksweep.sweep.stores.root import FORMAT
from linksweep.sweep.studies.study import Study
from linksweep.sweep.studies.values import DESIGNS
from linksweep.sweep.tables.file import content_digest


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean and how its ledger is laid out."""
    return {
        "linksweep_format": FORMAT,
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
        "ledger": json.dumps(shapes_of(study.experiment, keep_samples=study.keeps_samples)),
    }


def differences(attributes: Mapping[str, Any], study: Study) -> list[str]:
    """Say how the meaning of stored results differs from a study's; values of parameters that are an axis in either are
    not compared.
    """
    old, new = json.loads(attributes["study_meaning"]), json.loads(identity(study)["study_meaning"])
    axes = {*json.loads(attributes["study_axes"]), *study.axes}
    defaults = json.loads(json.dumps(study.experiment.defaults(), default=content_digest))
    pairs = [(key, old.get(key, "absent"), new.get(key, "absent")) for key in sorted({*old, *new} - {"fixed"})]
    pairs += [
        (f"fixed.{name}", old["fixed"].get(name, defaults.get(name)), new["fixed"].get(name, defaults.get(name)))
        for name in sorted({*old["fixed"], *new["fixed"]} - axes)
    ]
    return [f"{key}: {was!r} in the store, {now!r} in the study" for key, was, now in pairs if was != now]


def changed_points(attributes: Mapping[str, Any], study: Study) -> list[str]:
    """Say how a study's table of points differs from that of a store; nothing where one only has more rows at its end,
    or where either has no table.
    """
    document = json.loads(attributes.get("study_document", "{}"))
    table = document.get("points") or {}
    old: dict[str, list[Any]] = table.get("columns", {})
    if study.points is None or not old:
        return []
    names = list(dict.fromkeys([*old, *study.points.names]))
    settings = study.experiment.defaults()
    rows = min(len(next(iter(old.values()))), len(study.axes[study.points.names[0]]))
    was = {name: old.get(name) or rows * [document.get("fixed", {}).get(name, settings[name])] for name in names}
    now = {name: study.axes.get(name) or rows * [study.fixed.get(name, settings[name])] for name in names}
    changed = next(((i, n) for i in range(rows) for n in names if _differ(was[n][i], now[n][i])), None)
    if changed is None:
        return []
    row, name = changed
    sentences = [f"points, row {row + 1}: {name} is {was[name][row]!r} in the store, {now[name][row]!r} in the study"]
    return [*sentences, *_why(table.get("origin", {}), study.points.origin)]


def _differ(was: Any, now: Any) -> bool:
    return bool(was != (str(now) if isinstance(now, Named) else now))


def _why(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Say how two designs differ, or that a design cannot grow where that is the only reason."""
    if "design" not in old or "design" not in new:
        return []
    differing = [key for key in ("design", "n", "seed", "ranges") if old.get(key) != new.get(key)]
    if differing == ["n"] and not DESIGNS[new["design"]].grows:
        return [f"a {new['design']} design cannot grow: n = {new['n']} makes other points than n = {old['n']}"]
    return [f"points.{key} is {old[key]!r} in the store, {new[key]!r} in the study" for key in differing]
