"""Standard streams that are full or closed, and text that they cannot hold: a sentence or a clean exit code."""

import json
import os
import re
import subprocess
import sys

import pytest

import linksweep
from tests.tiers import slow

UNSAYABLE = r"""
def f(place: int, größe: float = 1.0):
    if place == 2:
        raise ValueError("\udc80 " + "x" * 10**6 + " the end")
    return place
"""
SAID = "error: standard output cannot be written: No space left on device\n"
LOUD = """
import gc, logging, os, sys
{at_import}
def loud(x: float):
    {in_function}
    if x == 2 and gc.isenabled():
        raise ValueError("no")
    return x
"""
WORDS = 'print("said"); os.system("echo said"); os.write(1, b"said\\n")'
LOG = "logging.basicConfig(stream=sys.stdout, level=logging.DEBUG, force=True)"
MORE = [slow(WORDS, LOG, "threads"), slow(WORDS, LOG, "serial"), slow(LOG, WORDS, "processes")]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store of which one point failed, with a message that no file can hold."""
    folder = tmp_path_factory.mktemp("streams")
    (folder / "f.py").write_text(UNSAYABLE)
    (folder / "study.toml").write_text('title = "Unsayable"\nexperiment = "f.py:f"\naxes = { place = [1, 2, 3] }\n')
    linksweep.run(folder / "study.toml", folder / "s.zarr", pool="serial")
    return folder / "s.zarr"


def shell(redirection, *arguments, unbuffered=""):
    """Run ``sweep`` with redirected streams; return exit code, standard output and standard error."""
    sweep = ["/bin/sh", "-c", f'exec "$@" {redirection}', "sh", sys.executable, "-m", "linksweep"]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run([*sweep, *map(str, arguments)], capture_output=True, text=True, env=environment, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("unbuffered", ["", slow("1")])
@pytest.mark.parametrize("command", ["list", *map(slow, ("--help", "show STORE", "show STORE --json"))])
def test_a_full_device_is_one_sentence(store, command, unbuffered):
    assert shell(">/dev/full", *command.replace("STORE", str(store)).split(), unbuffered=unbuffered) == (2, "", SAID)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_goes_ends_a_command_as_any_other(unbuffered):
    command = [sys.executable, "-m", "linksweep", "params", "linksweep.core.experiment:link", "--schema"]
    how = {"stdout": -1, "stderr": -1, "bufsize": 0, "env": os.environ | {"PYTHONUNBUFFERED": unbuffered}}
    with subprocess.Popen(command, **how) as process:
        process.stdout.read(10)  # there is more than a pipe holds
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 141)


@pytest.mark.parametrize("redirection", [*map(slow, [">&-", "2>&-", ">&- 2>&-", "2>/dev/full"]), "<&- >&- 2>&-"])
@pytest.mark.parametrize("command", ["list", *map(slow, ("show STORE", "status STORE --json"))])
def test_streams_that_nobody_reads_are_no_problem(store, command, redirection):
    arguments = command.replace("STORE", str(store)).split()
    code, said, err = shell(redirection, *arguments)
    assert (code, err) == (0, "")
    assert said == ("" if ">&-" in redirection.replace("2>&-", "") else shell("", *arguments)[1])


@pytest.mark.slow
def test_a_run_whose_streams_are_closed_or_full_is_kept(link_study, tmp_path):
    run = ("run", link_study, "--set", "n_sim=10", "--set", "n_cat=1", "--quiet", "-o")
    assert shell(">/dev/full", *run, tmp_path / "full.zarr") == (2, "", SAID)
    full = ("--log", "/dev/full", "--events", "/dev/full")
    assert shell("<&- >&- 2>&-", *run, tmp_path / "s.zarr", *full) == (0, "", "")
    for name in ("full.zarr", "s.zarr"):
        assert (linksweep.open(tmp_path / name).attrs["complete"], shell("", "check", tmp_path / name)[0]) == (1, 0)


def test_tiles_are_seen_json_is_ascii_and_a_wrong_option_needs_no_standard_error(store, monkeypatch):
    assert shell("2>/dev/full", "nonsense") == shell("2>&-", "nonsense") == (2, "", "")
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    assert json.loads(shell("", "params", f"{store.parent}/f.py:f", "--schema")[1])
    assert "##xx##" in shell("", "watch", store)[1].split()


@pytest.mark.slow
def test_a_message_that_no_file_can_hold_is_escaped_and_bounded(store, tmp_path):
    said = json.loads(linksweep.open(store).attrs["failures"])["place=2"]
    assert re.fullmatch(r"(?s)ValueError: \\udc80 xxx.{,9980}xxx the end", said)
    code, out, err = shell("", "status", store)
    assert (code, err, len(out) < 2_000) == (0, "", True)
    assert "ValueError: \\udc80 xxx" in " ".join(out.split())  # cut: --json has all of it
    assert json.loads(shell("", "status", store, "--json")[1])["failures"]["place=2"] == said
    run = ("run", store.parent / "study.toml", "-o", tmp_path / "s.zarr", "--log", tmp_path / "run.log")
    code, _, err = shell("", *run)
    assert (code, "Traceback" in err, said in (tmp_path / "run.log").read_text()) == (1, False, True)


@pytest.mark.parametrize(("at_import", "in_function", "pool"), [(LOG, WORDS, "threads"), *MORE])
def test_standard_output_has_results_alone_and_nothing_is_said_twice(tmp_path, at_import, in_function, pool):
    (tmp_path / "f.py").write_text(LOUD.format(at_import=at_import, in_function=in_function))
    asked = (f"{tmp_path}/f.py:loud", "--axis", "x=1,2,3", "-o", tmp_path / "s.zarr", "--json")
    again = ("reproduce", tmp_path / "s.zarr", "--at", "x=1", "--json", "--trust")
    commands = [("run", *asked, "--pool", pool), ("plan", *asked), again, ("params", asked[0], "--json")]
    for command in commands if pool == "serial" else commands[:1]:
        _, out, err = shell("", *command)
        assert json.loads(out), err
        assert err.count("failed at x=2.0") == (command[0] == "run")
