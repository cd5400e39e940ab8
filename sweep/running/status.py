"""How far a store is: its points by state, what failed and where it comes from, reported once or watched.

Nothing is written, nothing that the store names is run, and what has not changed is not read again.
"""

import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain, groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Block, Status, SweepError, count_status, ledger_key, progress_in_words
from linksweep.sweep.formatting import in_words, per_second
from linksweep.sweep.planning.grid import Grid, describe, failures_by_place
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.union import rounds_of
from linksweep.sweep.running.progress import Reasons
from linksweep.sweep.stores.integrity import MANIFEST, ROOT, STORE, newest
from linksweep.sweep.stores.ledger import Record, read_failures, read_keys
from linksweep.sweep.stores.location import Holder, Location, Where, holder, located, reading
from linksweep.sweep.stores.store import CUT_SHORT, UNFINISHED, OpenStore, find_root, is_new, manifest_of, store_at
from linksweep.sweep.studies.record import recorded_study
from linksweep.sweep.studies.study import LOST, PART, Part, in_ranges

# Attributes of a store without which its points are others.
ASKED = (STORE, "study_document", "study_digest", PART)

# Attributes of a store that its status shows. Not ``finished``, which is the time of the last writing.
PROVENANCE = ("study_digest", "study_overrides", "seed", "started", "host", "git_commit")

# Fewest tiles along the last dimension, where there are more points than tiles.
FEWEST_ACROSS = 40

# The most of a core that looking takes in the long run, and the longest time between looks for that reason.
SHARE, LONGEST_S = 0.008, 20.0

MISSING, DONE, FAILED, EXCLUDED, _ = map(int, Status)


class _Points:
    """The points of a study, and what each of them needs; arrays are by the index in the grid.

    ``wanted`` are the realisations of a point, infinite where a precision decides; ``cost`` is that of all of them.
    The speed of a run is that of what ``noun`` says.
    """

    def __init__(self, attributes: Mapping[str, Any], where: str) -> None:
        self.study = study = recorded_study(attributes, where)
        self.grid = Grid(study)
        plan = Plan(self.grid)
        share = plan.share()
        indices = self.grid.indices() if share is None else np.array(list(share), dtype=np.intp)
        self.is_adaptive = study.sampling.precision is not None
        self.noun = "points" if study.experiment.deterministic else "realisations"
        self.wanted, cost = np.zeros(len(self.grid)), np.ones(len(self.grid))
        self.wanted[indices] = math.inf if self.is_adaptive else study.sampling.n_cat * study.sampling.n_sim
        with suppress(SweepError):  # the record has no cost
            if not plan.costs_nothing_special:
                cost[self.grid.indices()] = [plan.cost(parameters) for _, parameters in self.grid.parameters()]
        whole = {one: plan.size(one).cost for one in set(cost.tolist())}
        self.cost = np.where(self.wanted > 0.0, [whole[one] for one in cost.tolist()], 0.0)
        starts = _numbers(self.grid.digests(indices))[:, 0]
        order = np.argsort(starts)
        self._starts, self._indices = starts[order], indices[order]
        special: dict[int, Sequence[Block]] = {i: blocks for i, blocks in (share or {}).items() if blocks is not None}
        more = self.find(_numbers(map(bytes.fromhex, study.counts))[:, 0])
        for point in self.grid.points(more[more >= 0]):
            special.setdefault(point.index, plan.blocks(cost[point.index], plan.parts_of(point)))
        for index, blocks in special.items() if not self.is_adaptive else ():
            self.wanted[index] = sum(block.realisations for block in blocks)
        shapes = {plan.block_shape(one): one for one in whole}  # points of one shape have the same blocks
        common = chain(*map(plan.blocks, shapes.values()), *special.values())
        self._ends = np.array([*{ledger_key(b"", block) for block in common}], dtype="S16")

    def find(self, starts: NDArray[np.uint64]) -> NDArray[np.intp]:
        """Return the indices of points by the first 8 bytes of their digests, -1 for those of no point."""
        order = np.argsort(starts)  # in order they are found three times as fast
        at = np.empty_like(order)
        at[order] = np.minimum(np.searchsorted(self._starts, starts[order]), len(self._starts) - 1)
        return np.where(self._starts[at] == starts, self._indices[at], -1)

    def progress(self, opened: OpenStore, blocks: NDArray[Any], failed: Iterable[bytes]) -> list[NDArray[Any]]:
        """Return how far the points are from the `blocks` in the ledger of a store and the digests of those that
        ``failed``: status, realisations, and which share of those that are wanted these are, 0 where it failed.  With a
        precision only the experiment can say which are done: those of the last writing.
        """
        index, numbers = blocks[:2].astype(np.int64)
        realisations = np.bincount(index, numbers, len(self.grid)).astype(np.int64)
        share = np.minimum(realisations / np.maximum(self.wanted, 1.0), 1.0)
        if self.is_adaptive and not is_new(opened.root):
            dataset = opened.dataset().transpose(*self.grid.dimensions, ...)
            done = dataset["status"].values.reshape(-1) == DONE  # perhaps beside blocks of a run without a precision
            share[done], realisations[done] = 1.0, dataset["n_sim_done"].values.reshape(-1)[done]
        at = self.find(_numbers(failed)[:, 0])
        status = np.select([self.wanted == 0.0, share == 1.0], [EXCLUDED, DONE], MISSING).astype(np.int8)
        status[at[at >= 0]], share[at[at >= 0]] = FAILED, 0.0
        return [self.grid.with_repeats(one) for one in (status, realisations, share)]

    def blocks(self, keys: NDArray[np.uint64], seconds: NDArray[Any]) -> NDArray[Any]:
        """Return the point, the realisations and the seconds of each block of this study with one of these keys."""
        index = self.find(keys[:, 0])
        ends = np.ascontiguousarray(keys[:, 2:]).view("S16").reshape(-1)  # of keys: what follows the digest
        good = (index >= 0) & (self.is_adaptive | np.isin(ends, self._ends))
        numbers = (keys[:, 3] & np.uint64(2**32 - 1)) * (keys[:, 3] >> np.uint64(32))
        return np.array([index, numbers, seconds])[:, good]


def _numbers(digests: Iterable[bytes]) -> NDArray[np.uint64]:
    """Return digests, or what else has 16 bytes, as two numbers each."""
    return np.frombuffer(b"".join(digests), "<u8").reshape(-1, 2)


def status_report(store: Where) -> dict[str, Any]:
    """Return the progress and provenance of a store, as its ledger has it, which is newer than its dataset.

    Nothing that the store names is imported: what an experiment declares, the store has recorded.  With a precision
    only the experiment can say what is left: the points that are done are those of the last writing, and a ``note``
    says so.  Where there are only parts of a store, it says which of them are lost.  Raises SweepError if there is
    neither.
    """
    location = located(store)
    with reading(location):
        parts = Part.among(location.beside(), location.name) if location.is_free() else []
    if parts:
        return _of_parts(location, parts)
    runs, opened = holder(location), OpenStore(location)
    attributes, ledger = opened.attributes, opened.ledger()
    points = _Points(attributes, str(location))
    study, grid = points.study, points.grid
    blocks = points.blocks(_numbers(ledger.rows.keys_of_rows()).reshape(-1, 4), ledger.seconds())
    status, realisations, _ = points.progress(opened, blocks, ledger.failures)
    is_written = ledger.manifest == manifest_of(opened.root)
    complete = is_written and bool(np.isin(status, (DONE, EXCLUDED)).all())
    state, why = _state_of(runs, status, is_written)
    note = {"note": why} if why == CUT_SHORT else {}
    if is_new(opened.root) and state != "running":
        note = {"note": UNFINISHED}
    if points.is_adaptive and not note and not complete:
        note = {"note": "as of the last writing: only the experiment can say how many realisations are needed"}
    least = study.sampling.n_sim * study.sampling.n_cat
    wanted = np.where(status == DONE, 0, grid.with_repeats(np.where(points.wanted < math.inf, points.wanted, least)))
    random = {"realisations": int(np.maximum(realisations, wanted).sum()), "realisations_done": int(realisations.sum())}
    return {
        "title": attributes["title"],
        "part": None if study.part is None else str(study.part),
        **note,
        "complete": complete,
        "state": state,
        "running": why if state == "running" else None,
        "points": {code.word: n for code, n in count_status(status).items()},
        "blocks": len(ledger.rows),
        **({} if study.experiment.deterministic else random),
        **({"lost_parts": attributes[LOST]} if LOST in attributes else {}),
        "rounds": [str(one) for one in rounds_of(attributes)],
        "warnings": json.loads(attributes.get("warnings", "[]")),
        "failures": failures_by_place(grid, status, ledger.failures),
        "command": attributes.get("command"),
        "provenance": {key: attributes[key] for key in PROVENANCE if attributes.get(key) not in (None, "")}
        | {"versions": json.loads(attributes.get("versions", "{}"))},
    }


def _state_of(runs: object, status: NDArray[np.int8], is_written: bool) -> tuple[str, str]:
    """Return whether a store is "running", "finished" or "stopped" (nobody runs it), and why; ``runs`` is its `holder`
    before it was read, so that a run which ends meanwhile is not taken for one that was killed.
    """
    if runs is not None:
        return "running", str(runs)
    if (status == MISSING).any():
        return "stopped", "nobody runs it"
    return ("finished", "") if is_written else ("stopped", CUT_SHORT)


def _of_parts(store: Location, parts: Sequence[Part]) -> dict[str, Any]:
    """Return how far the parts of a store are, by how many there are, and which are lost: not there, or neither
    finished nor running.
    """
    report: dict[str, Any] = {"title": f"{store} is not merged yet; its parts:", "parts": {}}
    for total, some in groupby(parts, key=lambda part: part.total):
        states: dict[str, list[int]] = {"complete": [], "failed": [], "running": []}
        for part in some:
            if (opened := store_at(part.place(store))) is None:
                continue  # it was killed as it began
            ended = "complete" if opened.attributes.get("failures", "{}") == "{}" else "failed"
            if (runs := holder(part.place(store))) or opened.attributes["complete"]:
                states["running" if runs else ended].append(part.number)
        states["lost"] = sorted({*range(1, total + 1)}.difference(*states.values()))
        report["parts"][total] = {state: in_ranges(numbers) for state, numbers in states.items() if numbers}
    return report


class Tile(NamedTuple):
    """Some neighbouring points: their ``state``, which share of their realisations is done, and all that in words."""

    state: str
    share: float
    words: str


class Watched:
    """A store that is watched, whether it is there or not.

    ``state`` is "waiting" (for the store), "gone", "unreadable" or as `_state_of` says, and
    ``words`` say more; ``opened`` is the store as it was last read.  ``reasons`` say how many points failed for
    each reason, the most frequent first, with the place of one of them and a record.  ``status`` and ``share``, which
    of their realisations is done, are those of all points in C order.
    """

    def __init__(self, where: Where) -> None:
        """Look at nothing yet."""
        self.location = located(where)
        self.state, self.words, self.title = "", "", self.location.name
        self.opened: OpenStore | None = None
        self._runs: Holder | None = None
        self._forget()

    def _forget(self) -> None:
        self._files: tuple[bytes | None, bytes | None] = (None, None)
        self._points: _Points | None = None
        self._asked: tuple[Any, ...] = ()
        self._parts: dict[str, NDArray[Any]] = {}
        self.reasons: list[tuple[int, str, Record]] = []
        self._places: list[str] = []
        self._is_written = False
        self._ended = math.inf  # points or realisations
        # The first and the last delivery: when, the cost that was left then, what had ended, and how many blocks.
        self._seen: list[tuple[float, float, int, int]] = []
        self.status, self.share = np.zeros(0, dtype=np.int8), np.zeros(0)

    @property
    def is_over(self) -> bool:
        """Whether nothing will change unless somebody begins another run."""
        is_lost = self.state == "unreadable" and self.opened is None
        return is_lost or self.state in ("finished", "stopped", "gone")

    def look(self) -> None:
        """Read what has changed."""
        try:
            with reading(self.location):
                runs = holder(self.location)
                if runs != self._runs:  # the speed is that of one run, without the time before it
                    self._runs, self._ended, self._seen = runs, math.inf, []
                self._read()
            if self.opened is not None and self._points is not None:
                self.state, self.words = _state_of(runs, self.status, self._is_written)
            else:
                self.state, self.words = ("waiting", "no store yet") if self.opened is None else ("gone", "removed")
        except SweepError as error:
            self.state, self.words = "unreadable", "; ".join(error.problems)

    def _read(self) -> None:
        root = self.location.get(ROOT)
        if root is None and find_root(self.location) is None:
            self._forget()
            return
        try:
            opened, points = self._open(root)
            manifest = self.location.get(MANIFEST)  # after the root, which is never ahead of it
            if (root, manifest) != self._files:
                self._take(opened, points, manifest)
                self._files = root, manifest
        except (ValueError, LookupError, TypeError, ArithmeticError, MemoryError, RuntimeError) as error:
            if holder(self.location) is None:  # else its run has replaced a file meanwhile
                why = f"its ledger cannot be read ({error}); `sweep check` says more"
                raise SweepError(why, str(self.location)) from error

    def _open(self, root: bytes | None) -> tuple[OpenStore, _Points]:
        """Return the store and its points, as they were if the root is as it was."""
        if self.opened is None or self._points is None or root != self._files[0]:
            self.opened = OpenStore(self.location)
            attributes = self.opened.attributes
            asked = tuple(map(attributes.get, ASKED))
            if self._points is None or asked != self._asked:
                self._forget()
                self._points, self._asked = _Points(attributes, str(self.location)), asked
                self.title = str(attributes.get("title", self.title))
        return self.opened, self._points

    def _take(self, opened: OpenStore, points: _Points, content: bytes | None) -> None:
        manifest = newest(content, manifest_of(opened.root))
        failed = read_failures(self.location, manifest)
        new = [part for part in manifest.parts if part.rows.name not in self._parts]
        keys = zip(new, read_keys(self.location, new), strict=True)
        known = self._parts | {part.rows.name: points.blocks(*one) for part, one in keys}
        self._parts = {part.rows.name: known[part.rows.name] for part in manifest.parts}
        self._is_written = manifest == manifest_of(opened.root)
        blocks = np.hstack([np.zeros((3, 0)), *self._parts.values()])
        self.status, realisations, self.share = points.progress(opened, blocks, failed)
        records = {record["message"]: record for record in failed.values()}
        reasons = Reasons(failures_by_place(points.grid, self.status, failed)).most()
        self.reasons = [(number, place, records[message]) for number, place, message in reasons]
        left = float((points.cost * (1.0 - self.share))[self.status == MISSING].sum())
        ended = int(np.isin(self.status, (DONE, FAILED)).sum() if points.noun == "points" else realisations.sum())
        now = time.monotonic(), left, ended, blocks.shape[1]
        if ended > self._ended:
            self._seen = [*self._seen[:1], now]
            self._longest = np.fmax.reduce(blocks[2, self._seen[0][3] :], initial=0.0)
        elif ended < self._ended:  # a first look is somewhere between two deliveries, unless there was none yet
            self._seen = [] if ended else [now]
        self._ended = ended

    @property
    def progress(self) -> str:
        """How many points are done and failed, in words; '' where no store is."""
        missing, done, failed, _ = count_status(self.status).values()
        return progress_in_words(done, failed, missing + done + failed) if self.status.size else ""

    @property
    def bar(self) -> dict[str, float]:
        """How many points are done, running (the share of them that is done), failed and waiting."""
        missing, done, failed, _ = count_status(self.status).values()
        begun = float(self.share[self.status == MISSING].sum())
        return {"done": done, "running": begun, "failed": failed, "waiting": missing - begun}

    @property
    def speed(self) -> str:
        """The speed and the time left of a run, '' while they are not known."""
        if self.state != "running" or len(self._seen) < 2 or self._points is None:
            return ""
        (then, before, first, _), (now, after, last, _) = self._seen
        if now - then < 2.0 * self._longest:  # what workers had begun before counts as much
            return ""
        speed = per_second(last - first, now - then, self._points.noun)
        left = after * (now - then) / (before - after) - (time.monotonic() - now) if before > after else 0.0
        if self._points.is_adaptive or left <= 0.0:
            return speed
        return f"{100 * (1 - after / self._points.cost.sum()):.0f} % of the work, {speed}, about {in_words(left)} left"

    def tiles(self, most: int, across: int, most_rows: int) -> list[list[Tile]]:
        """Return about ``most`` tiles, in at most ``most_rows`` of at most ``across`` along the last dimension.

        A single row goes on in the next line; rows of excluded points are left out.
        """
        if self._points is None or not self.status.size:
            return []
        grid = self._points.grid
        columns = grid.shape[-1] if grid.shape else 1
        rows = len(grid) // columns
        wide = math.ceil(columns / min(most if rows == 1 else across, max(FEWEST_ACROSS, most // rows)))
        high = math.ceil(rows / max(1, min(most_rows, most // math.ceil(columns / wide))))
        down, along = np.arange(0, rows, high), np.arange(0, columns, wide)
        if len(self._places) != len(down) * len(along):
            first = (down[:, None] * columns + along).reshape(-1)
            self._places = [describe(grid.study, point.parameters) for point in grid.points(first)]
        states = np.array([FAILED, MISSING, DONE, EXCLUDED])[:, None]
        layers = np.vstack([self.status == states, self.share]).reshape(-1, rows, columns)
        sums = np.add.reduceat(np.add.reduceat(layers, down, axis=1), along, axis=2).reshape(len(layers), -1)
        tiles = [_tile(place, *counts) for place, counts in zip(self._places, sums.T.tolist(), strict=True)]
        length = min(len(along), across)
        rows_of_tiles = (tiles[start : start + length] for start in range(0, len(tiles), length))
        return [row for row in rows_of_tiles if any(tile.state != "excluded" for tile in row)]


def _tile(place: str, failed: float, missing: float, done: float, excluded: float, share: float) -> Tile:
    """Return a tile of so many points; ``share`` is the sum of theirs."""
    counts = {"failed": failed, "missing": missing, "done": done, "excluded": excluded}
    state, share = next(word for word, n in counts.items() if n), share / max(missing + done, 1.0)
    state = ("running" if share else "waiting") if state == "missing" else state
    words = f"{state}, {100.0 * share:.0f} %" if state == "running" else state
    if (points := sum(counts.values())) > 1:
        words = f"{points:,.0f} points: {', '.join(f'{n:,.0f} {word}' for word, n in counts.items() if n)}"
    return Tile(state, share, f"{place}: {words}" if points == 1 else f"from {place}, {words}")


def pause(interval: float, took: float) -> float:
    """Return for how many seconds to wait after a look that took so many of a core."""
    return max(interval, min(took / SHARE, LONGEST_S))
