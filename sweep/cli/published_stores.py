"""The stores of a report or a comparison: those a user names, or those of the built-in studies."""

import tomllib
from collections.abc import Sequence
from pathlib import Path

from linksweep.sweep.analysis.compare import Comparison, compare, remarks
from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.checked_grid import make_grid
from linksweep.sweep.running.run import plan_study
from linksweep.sweep.stores.location import Where, located, reading
from linksweep.sweep.stores.store import OpenStore, open_dataset
from linksweep.sweep.studies.document import built_in_studies
from linksweep.sweep.studies.reader import load_study
from linksweep.sweep.studies.study import Study

PAPER_ORDER = (
    *("algorithm", "error-surface", "sqrt-n", "scatter", "quasars", "galaxies", "completeness", "mission-length"),
    *("aberration", "radio-stars"),
)
"""The studies of Metz & Geffert 2004, by section; all others follow, sorted by name."""


def compare_stores(stores: Sequence[Where]) -> tuple[list[Comparison], list[str]]:
    """Return the comparisons of all stores, and remarks about them.

    Raises SweepError for a place without a store, or a store of a study that has neither published numbers nor claims.
    """
    comparisons: list[Comparison] = []
    sentences: list[str] = []
    for store in stores:
        dataset = open_dataset(store)
        try:
            found = compare(dataset)
        except SweepError as error:
            raise SweepError(error.problems, str(store)) from error
        overrides = dataset.attrs.get("study_overrides")
        changed = [f"the study was changed on the command line: {overrides}"] if overrides else []
        about = [*changed, *remarks(dataset)]
        if not found and not about:
            raise SweepError("its study has neither published numbers nor claims to compare with", str(store))
        comparisons += found
        sentences += [f"{store}: {sentence}" for sentence in about]
    return comparisons, sentences


def paper_studies(published: bool) -> list[Study]:
    """Return the built-in studies, or those that have ``published`` numbers or claims; raises SweepError like
    `load_study`.
    """
    documents = {name: tomllib.loads(path.read_text(encoding="utf-8")) for name, path in built_in_studies().items()}
    names = [n for n, document in documents.items() if not published or {"published", "claim"} & document.keys()]
    others = sorted(set(names).difference(PAPER_ORDER))
    return [load_study(name) for name in (*PAPER_ORDER, *others) if name in names]


def store_of(study: Study, results: Path) -> Path:
    """Return the default place of a study's store in a folder of results."""
    return results / f"{study.name}.zarr"


def unfinished(studies: Sequence[Study], results: Path) -> list[Study]:
    """Return the studies whose store is missing or incomplete, or was written for another text or with overrides.

    Raises SweepError, before anything runs, for a study whose store cannot be continued.
    """
    pending = [study for study in studies if not _is_finished(study, store_of(study, results))]
    for study in pending:
        plan_study(study, store_of(study, results))
    return pending


def lacks_packages(study: Study, results: Path) -> str:
    """Return which optional packages must be installed to run a study; '' if none, or if its store is finished."""
    if _is_finished(study, store_of(study, results)):
        return ""
    try:
        make_grid(study)
    except SweepError as error:
        found = [problem for problem in error.problems if "pip install" in problem]
        return found[0] if len(found) == len(error.problems) else ""
    return ""


def _is_finished(study: Study, store: Where) -> bool:
    location = located(store)
    with reading(location):
        if location.is_free():
            return False
    attributes = OpenStore(store).attributes
    same = attributes.get("study_digest") == study.digest() and attributes.get("study") == study.text
    return same and bool(attributes.get("complete"))
