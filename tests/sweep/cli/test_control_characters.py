"""Text of others never controls the terminal: marked sequences in every text of functions, tables and stores."""

import csv
import json
import os
import pty
import re
import subprocess
import sys
from contextlib import suppress

import pytest
from hypothesis import example, given, strategies as st

from tests.conftest import run_sweep
from tests.sweep.opening import IN_TEXT, Column, Table, harmless, places_in, replaced, sealed
from tests.tiers import slow

MARK = "\x1b]0;owned\x07\x9b2J\u202e\x1b[31m\r\x08"
CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
OURS = re.compile("\x1b\\[[0-9;]*m|\r(?=\n)")  # styles; what a terminal makes of the end of a line
FUNCTION = f'''
import warnings
MARK = {MARK!r}

def marked(x: float = 1.0, kind: str = "a"):
    """{"Title " + repr(MARK)[1:-1]}"""
    warnings.warn("warns " + MARK)
    print("prints " + MARK)
    if x == 2.0:
        raise ValueError("fails " + MARK)
    return {{"number": x, "text": "=cmd()" + MARK, "other": MARK + "\\r\\nforged"}}
'''
KINDS = ["a" + MARK, "@b"]
STUDY = f"""
title = "Marked"  # in a title these characters are refused
experiment = "marked.py:marked"
axes = {{ x = [1.0, 2.0, 3.0], kind = {json.dumps(KINDS)} }}
"""
LOOKS = [  # at a store s.zarr and its study
    *(["show", "s.zarr", "--format", form] for form in ("text", "csv", "ecsv")),
    ["fit", "s.zarr", "--over", "x"],
    *([look, "s.zarr"] for look in ("status", "check", "compare", "sensitivity", "report")),
    *(["plot", "s.zarr", "-o", "z\n.png"], ["run", "marked.py:marked", "--axis", "kind=\udcc3,b", "-o", "u.zarr"]),
    *(["plan", "study.toml"], ["params", "study.toml"], ["merge", *["s.zarr"] * 2, "-o", "m.zarr"]),
    *(["reproduce", "s.zarr", "--at", "x=1,kind=@b"], ["run", "--retry", "s.zarr"], ["show", "no" + MARK]),
    *(["show", "s.zarr", "--json"], ["status", "s.zarr", "--json"], ["find", "s.zarr", "--where", "number > 1.5"]),
]


def controls_in(text):
    return {text[max(0, one.start() - 30) : one.end() + 30] for one in CONTROLS.finditer(text)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("marked")
    (folder / "marked.py").write_text(FUNCTION)
    (folder / "study.toml").write_text(STUDY)
    command = ["run", "study.toml", "--pool", "serial", "-o", "s.zarr", "--log", "run.log", "--verbose"]
    code, out, err = run_sweep(*command, cwd=folder)
    assert (code, "fails" in err, "warns" in err) == (1, True, True), err
    assert not controls_in(out + err + (folder / "run.log").read_text())
    return folder


@pytest.mark.parametrize("look", [slow(look) if "report" in look else look for look in LOOKS], ids=" ".join)
def test_commands_escape_what_a_function_and_a_study_say(folder, sweep, look):
    code, out, err = sweep(*look, cwd=folder)
    whole = "Traceback" not in err and "z\n" not in err and ("--format" not in look or r"\u001b[31m" in out)
    pages = re.sub("(?s)<script.*?</script>", "", "".join(page.read_text() for page in folder.glob("*.html")))
    assert (code in (0, 1, 2), whole, controls_in(out + err + pages)) == (True, True, set()), err
    if look[0::2] == ["show", "--json"]:
        assert {row["kind"] for row in json.loads(out)["rows"]} == set(KINDS)


@pytest.mark.parametrize(
    ("look", "kind"),
    [("show", "dumb"), ("all-the-results", "dumb"), *(slow(x, "xterm") for x in ("show", "compare", "status"))],
)
def test_a_terminal_gets_styles_of_ours_alone(folder, look, kind):
    (ours, theirs), said = pty.openpty(), b""
    command = [sys.executable, "-m", "linksweep", look, "s.zarr"]
    narrow = os.environ | {"TERM": kind, "COLUMNS": "40"}
    with subprocess.Popen(command, cwd=folder, stdout=theirs, stderr=theirs, env=narrow):
        os.close(theirs)
        with suppress(OSError):  # the other end is closed
            while part := os.read(ours, 65536):
                said += part
    os.close(ours)
    text = said.decode()
    assert look != "show" or (("\x1b" in text) == (kind == "xterm") and "left out to fit 40 columns:" in text)
    assert look != "all-the-results" or "command\r\n'all-the-results'" in text  # no word is broken
    assert not controls_in(OURS.sub("", text))
    assert "31m" not in text.replace("u001b[31m", "")


def value_at(document, at):
    for step in at:
        document = json.loads(document) if step is IN_TEXT else document[step]
    return document


@pytest.mark.slow
@pytest.mark.parametrize(("file", "least"), [("zarr.json", 20), ("blocks/zarr.json", 1)])
def test_commands_escape_every_text_of_a_store(folder, sweep, file, least):
    store = folder / "s.zarr"
    original = (store / file).read_bytes()
    document = json.loads(original)
    texts = {("attributes", *at): value_at(document["attributes"], at) for at in places_in(document["attributes"])}
    marked = {at: text + MARK for at, text in texts.items() if isinstance(text, str) and text[:1] not in ("{", "[")}
    marked.pop(("attributes", "checksum"), None)
    assert len(marked) >= least
    try:
        for at, text in marked.items():
            (store / file).write_bytes(sealed(replaced(document, at, text), file))
            for look in LOOKS[:1] + LOOKS[3:7]:
                _, out, err = sweep(*look, cwd=folder)
                assert ("Traceback" in err, controls_in(out + err)) == (False, set()), (at, look, err)
    finally:
        (store / file).write_bytes(original)


@given(st.text())
def test_harmless_text_is_what_it_was_but_for_controls(text):
    assert not controls_in(harmless(text))
    assert json.loads(f'"{harmless(json.dumps(text, ensure_ascii=False)[1:-1])}"') == text


@example("0\r")
@example(" =a")
@given(st.text())
def test_no_cell_of_csv_is_a_formula(text):
    table = Table([Column("a", [""]), Column("b", [text])])
    ((_, said),) = list(csv.reader([*table.csv().partition("\n")[2].splitlines(True)]))
    assert not controls_in(said)
    try:
        float(text)
    except ValueError:
        assert not said.lstrip().startswith(("=", "+", "-", "@"))
        assert said.removeprefix("'") == harmless(text).removeprefix("'")
