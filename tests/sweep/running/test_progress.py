"""What a person sees of a run, and what the log file keeps."""

import logging
import re
import shutil
import sys

import pytest
from click.testing import CliRunner

from linksweep.sweep.cli import main
from linksweep.sweep.running.progress import SENTENCES
from tests.tiers import PATIENCE_S

FAULTY = """
import logging
from tests.sweep import coins
from dataclasses import replace

def toss(points, n_sim, rng, catalogue_rng):
    if points[0]["coins"] == 5:
        raise ZeroDivisionError("no coins left")
    return coins.toss(points, n_sim, rng, catalogue_rng)

experiment = replace(coins.experiment, evaluate=toss)
"""

STUDY = """
title = "Coins"
experiment = "faulty.py:experiment"
[axes]
metal = ["gold", "tin"]
coins = [1, 5]
[sampling]
n_sim = 10
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "faulty.py").write_text(FAULTY)
    (tmp_path / "study.toml").write_text(STUDY)
    return "study.toml"


def run(*options):
    return CliRunner().invoke(main, ["run", "study.toml", "--pool", "serial", *options])


def test_quiet_prints_the_table_and_errors(study):
    good = run("--quiet", "--set", "coins=1", "-o", "good.zarr")
    assert good.exit_code == 0
    assert good.stderr == ""
    assert "tin" in good.stdout
    bad = run("-q")
    assert bad.exit_code == 1
    assert len(bad.stderr.splitlines()) == 1
    assert bad.stderr.startswith("2 points failed")


def test_verbose_tells_each_point(study):
    told = run("--verbose").stderr.splitlines()
    assert sorted(line for line in told if line.startswith("metal=")) == [
        "metal=gold,coins=1: done",
        "metal=gold,coins=5: failed (exception)",
        "metal=tin,coins=1: done",
        "metal=tin,coins=5: failed (exception)",
    ]


def test_the_log_has_everything_with_times_and_tracebacks_and_grows(study, tmp_path):
    assert run("--quiet", "--log", "run.log").exit_code == 1
    first = (tmp_path / "run.log").read_text()
    assert re.search(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO 4 points; 40 realisations", first, re.MULTILINE)
    assert "DEBUG metal=gold,coins=1: done" in first
    assert "ERROR metal=tin,coins=5: failed (exception): ZeroDivisionError: no coins left" in first
    assert first.count("Traceback (most recent call last)") == 2
    assert 'raise ZeroDivisionError("no coins left")' in first
    assert "realisations/s" in first
    run("--log", "run.log")
    assert (tmp_path / "run.log").read_text().startswith(first)


@pytest.mark.parametrize("place", ["no/such/folder/run.log", "results", "/proc/run.log", "a\0b"])
def test_a_log_that_cannot_be_written_ends_it_before_anything_is_computed(study, tmp_path, place):
    (tmp_path / "results").mkdir()
    refused = run("--log", place)
    assert refused.exit_code == 2
    assert f"{place!r} cannot be written" in refused.stderr
    assert not list((tmp_path / "results").iterdir())


@pytest.fixture
def told():
    """What a progress says."""
    lines = []

    class Keep(logging.Handler):
        def emit(self, record):
            lines.append(record.getMessage())

    handler = Keep()
    level = SENTENCES.level
    SENTENCES.addHandler(handler)
    SENTENCES.setLevel(logging.INFO)
    yield lines
    SENTENCES.removeHandler(handler)
    SENTENCES.setLevel(level)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("script") is None, reason="needs the command script, which has a terminal")
def test_on_a_terminal_the_bar_shows_the_time_left(link_study, tmp_path, start_sweep):
    """The bar is drawn again and again; what stays are the sentences."""
    inner = (
        f"TERM=xterm {sys.executable} -m linksweep run {link_study} -o {tmp_path}/s.zarr --set n_sim=100000 --workers 1"
    )
    process = start_sweep(command=["script", "-qec", inner, "/dev/null"])
    shown, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, shown
    assert "━" in shown
    assert re.search(r"of the work\), about \d+ s left, \d", re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown))
    assert "wrote" in shown
