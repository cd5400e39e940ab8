"""Documents of a store that were forged, with a right checksum: every command gives a sentence, never a traceback."""

import json
import random
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

import linksweep
from linksweep.sweep.cli import main
from linksweep.sweep.stores.integrity import sealed
from tests.tiers import slow

MODEL = "def model(x: float = 1.0, k: int = 1):\n    return {'y': x * k, 'name': f'{x:g}'}\n"
IN_TEXT = "<JSON>"
"""A step from a text into the document that it holds."""


def nested(depth):
    return [nested(depth - 1)] if depth else []


VALUES = [10**30, 2**62, 0, -1, 1e308, nested(500), "x", "[" * 5000, None, True, [], {}, [10**12], {"x": 1}]

COMMANDS = [
    *(["status", "S"], ["show", "S"], ["check", "S"], ["find", "S", "--where", "y > 1", "--over", "x"]),
    *(["merge", "S", "other.zarr", "-o", "m.zarr"], ["plan", "model.py:model", "--axis", "x=1,2,5", "-o", "S"]),
    *(["run", "model.py:model", "--axis", "x=1,2,3", "-o", "S", "--pool", "serial"], ["check", "S", "--repair"]),
]


def inside(text):
    try:
        found = json.loads(text) if text[:1] in ("{", "[") else None
    except (ValueError, RecursionError):
        return None
    return found


def places(document, at=()):
    """Yield the way to every field of a document, also of documents in its texts; of lists to the first two items."""
    if at and at != ("attributes", "checksum"):
        yield at
    if isinstance(document, str) and (found := inside(document)) is not None:
        yield from places(found, (*at, IN_TEXT))
    items = document.items() if isinstance(document, dict) else ()
    items = enumerate(document[:2]) if isinstance(document, list) else items
    for step, value in items:
        yield from places(value, (*at, step))


def replaced(document, at, value):
    if not at:
        return value
    step, *rest = at
    if step == IN_TEXT:
        return json.dumps(replaced(json.loads(document), rest, value))
    changed = document.copy()
    changed[step] = replaced(document[step], rest, value)
    return changed


@pytest.mark.parametrize("trials", [10, slow(200)])
def test_every_command_gives_a_sentence(tmp_path, monkeypatch, trials):
    monkeypatch.chdir(tmp_path)
    Path("model.py").write_text(MODEL)
    linksweep.run("model.py:model", "s.zarr", axes={"x": [1.0, 2.0], "k": [1, 2]}, pool="serial")
    linksweep.run("model.py:model", "other.zarr", axes={"x": [7.0], "k": [1, 2]}, pool="serial")
    store = Path("s.zarr")
    files = [path.relative_to(store).as_posix() for path in store.rglob("zarr.json")]
    rng = random.Random(4)
    for trial in range(trials):
        file = rng.choice(["zarr.json", rng.choice(files)])
        document = json.loads((store / file).read_text())
        at, value = rng.choice(list(places(document))), rng.choice(VALUES)
        forged = replaced(document, at, value)
        is_sealed = isinstance(forged.get("attributes"), dict)
        content = sealed(forged, file) if is_sealed else json.dumps(forged).encode()
        for command in COMMANDS:
            for old in ("S", "m.zarr"):
                shutil.rmtree(old, ignore_errors=True)
            shutil.copytree(store, "S")
            (Path("S") / file).write_bytes(content)
            done = CliRunner().invoke(main, command)
            said = (trial, command, file, at, repr(value)[:50])
            assert done.exception is None or isinstance(done.exception, SystemExit), (said, repr(done.exception))
            assert done.exit_code in (0, 1, 2), said


@pytest.mark.parametrize("field", ["title", "generation", "study_meaning", "manifest"])
def test_the_field_is_named(tmp_path, field):
    (tmp_path / "model.py").write_text(MODEL)
    linksweep.run(f"{tmp_path}/model.py:model", tmp_path / "s.zarr", axes={"x": [1.0]}, pool="serial")
    root = json.loads((tmp_path / "s.zarr" / "zarr.json").read_text())
    root["attributes"][field] = [1]
    (tmp_path / "s.zarr" / "zarr.json").write_bytes(sealed(root, "zarr.json"))
    with pytest.raises(linksweep.SweepError, match=rf"zarr\.json is damaged \(attributes\.{field}: "):
        linksweep.open(tmp_path / "s.zarr")
