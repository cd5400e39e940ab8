"""The store of a study: whether what is there can go on with it, in the terms of the root document, and opening it."""

import json
from collections.abc import Mapping
from typing import Any

from linksweep.sweep.contract import Named, SweepError
from linksweep.sweep.stores import store as stores
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import OpenStore, Store
from linksweep.sweep.studies.points import DESIGNS
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.file import content_digest

RESERVED = {"blocks"}
"""Names in a store that are not those of arrays."""


def find_store(where: Where, study: Study) -> OpenStore | None:
    """Return the store at a place, None where the place is free.

    Raises SweepError where something else is there, or results that cannot be mixed with this study's.
    """
    names = {*study.axes, *study.experiment.coordinates}
    names |= {output.name for output in (*study.experiment.outputs, *study.experiment.sample_outputs)}
    if taken := sorted(RESERVED & names):
        raise SweepError(f"no axis or result can be named {', '.join(taken)}: a store has a group of that name")
    opened = stores.find_store(where)
    if opened is not None and (different := differences(opened.attributes, study)):
        raise SweepError(
            ["holds results of a different study, which would be mixed up; give another store with -o", *different],
            str(opened.location),
        )
    return opened


def open_store(opened: OpenStore, study: Study) -> Store:
    """Return the open store of a study; raises SweepError where files of its ledger are damaged, or where it has rows
    of another version of the experiment.
    """
    store = Store(opened, identity(study))
    hold(store, study)
    return store


def hold(store: Store, study: Study) -> None:
    """Let the ledger of a store have rows as the experiment makes them, once their type is known."""
    if not study.experiment.undeclared:
        width = study.experiment.samples_width if study.keeps_samples else 0
        store.hold(study.experiment.reducer.dtype, width)


def create_store(where: Where, study: Study, attributes: Mapping[str, Any]) -> OpenStore:
    """Make the store of a study at a free place, in one step, in which nothing is done yet."""
    return stores.create_store(where, {**attributes, **identity(study)})


def replace_store(where: Where, study: Study, attributes: Mapping[str, Any]) -> OpenStore | None:
    """Begin the store that is there anew, as `linksweep.sweep.stores.store.replace_store`, for a study."""
    return stores.replace_store(where, {**attributes, **identity(study)})


def check_points(opened: OpenStore, study: Study) -> None:
    """Raise SweepError where rows of a study's table of points differ from those of a store."""
    if changed := changed_points(opened.attributes, study):
        raise SweepError(
            [
                "holds a table of other points; a table may only grow at its end: give another store with -o, or "
                "--fresh replaces this one",
                *changed,
            ],
            str(opened.location),
        )


def identity(study: Study) -> dict[str, Any]:
    """Return the attributes of a store that say what its numbers mean."""
    return {
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
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
