"""Bad input gives one message that names value, allowed values and place, exit code 2, and leaves nothing behind."""

import json
import subprocess
import sys

import pytest

from tests.conftest import run_sweep
from tests.tiers import slow

GOOD = """\
title = "A good study"

[axes]
v_max = [16.0, 17.0]
n_obj = [20, 50]

[fixed]
catalogue = "quasars"

[sampling]
n_sim = 10
seed = 7
"""
DECAY = b"def decay(years: float, half_life: float, rng):\n    return {'left': rng.random() ** years, 'lost': years}\n"
NO_ADDRESSES = ["host", "nonsense://x:1", "tcp://", "tcp://:1"]
NOT_A_STORE = "is not a store of linksweep"
ROOT = {"zarr_format": 3, "node_type": "group"}
FOREIGN = {  # by what stands there: its files, and what is said
    "a directory": ({"thesis.txt": "irreplaceable"}, NOT_A_STORE),
    "a file": ({"": "irreplaceable"}, NOT_A_STORE),
    "half made": ({"blocks/zarr.json": "{}"}, "zarr.json and the copy in blocks are damaged"),
    "cut metadata": ({"zarr.json": '{"attributes": {"linksweep_f'}, NOT_A_STORE),
    "foreign Zarr": ({"zarr.json": json.dumps(ROOT | {"attributes": {"a": 1}})}, NOT_A_STORE),
    "newer": ({"zarr.json": json.dumps(ROOT | {"attributes": {"linksweep_format": 99}})}, "It is newer: upgrade"),
    "older": ({"zarr.json": json.dumps(ROOT | {"attributes": {"linksweep_format": 1}})}, "It is older: run the study"),
}


def tree(folder):
    return {p: p.read_bytes() if p.is_file() and not p.is_symlink() else None for p in sorted(folder.rglob("*"))}


@pytest.fixture
def here(here):
    (here / "study.toml").write_text(GOOD)
    return here


def write(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def check_refused(here, arguments, *phrases):
    before = tree(here)
    code, out, err = run_sweep(*arguments)
    assert (code, out, "Traceback" in err, len(err) < 20_000) == (2, "", False, True), err
    assert all(phrase in err for phrase in phrases), err
    assert tree(here) == before
    return err


def axis(spec, n_obj="[20, 50]"):
    return GOOD.replace("[16.0, 17.0]", spec).replace("[20, 50]", n_obj)


def fixed(line):
    return GOOD.replace("[fixed]", f"[fixed]\n{line}")


def after(section):
    return f"{GOOD}\n{section}\n"


CSV, ZIP = "published/table.csv", '[grid]\nzip = [["v_max", "n_obj"]]'
PUBLISHED = f'[published]\nfile = "{CSV}"\nsource = "A paper"'
STUDIES = {
    "axes as tables": (after("[[axes.zz]]\na = 1"), "axes.zz (line 14): unknown parameter 'zz'"),
    "condition that nothing meets": (after("[when.v_max]\nmodel = []"), "when.v_max.model (line 15): list should have"),
    "string for number": (fixed('error_scale = "two"'), "fixed.error_scale (line 8): error_scale = 'two': must be"),
    "control character in the title": (GOOD.replace("A good", r"A \u001b[2J"), "title (line 1): 'A \\x1b[2J"),
    "vector as axis": (axis("[1]\nomega = [[1, 1, 1]]"), "axes.omega (line 5): a vector cannot be an axis"),
    "empty axis": (axis("[]"), "axes.v_max (line 4): an axis needs at least one value"),
    "duplicate value": (axis("[16.0, 17, 16, 17.0]"), "axes.v_max (line 4): duplicate values 16.0, 17.0"),
    "zero step": (axis("{ start = 14, stop = 16, step = 0 }"), "step = 0: does not lead from start = 14 to stop ="),
    "too many points": (axis("{ start = 14, stop = 16, num = 1000000 }", str([*range(2, 22)])), "the grid"),
    "duplicate point through zip": (axis("[16.0, 17.0, 16.0]", "[20, 50, 20]") + ZIP, "axes.v_max"),
    "everything excluded": (after("[[exclude]]\nv_max = { above = 1 }"), "every point of the grid is excluded"),
    "unknown condition": (after("[[exclude]]\nv_max = { over = 1 }"), "exclude.0.v_max (line 15): unknown"),
    "many unknown keys": (fixed("\n".join(f"k{i} = {i}" for i in range(5_000))), "... and perhaps more problems"),
    "experiment without a colon": (f'experiment = "core"\n{GOOD}', "experiment (line 1): 'core': must be"),
    "not an experiment": (f'experiment = "math:tau"\n{GOOD}', "has a float, not an Experiment or a function, at"),
    "published file missing": (after(PUBLISHED), "published.file (line 15): 'published/table.csv' cannot be read:"),
    "published file a device": (after(PUBLISHED.replace(CSV, "/dev/zero")), "'/dev/zero' is larger than 1,000,000"),
}
LOST = b"""import dataclasses, linksweep.core.experiment
def check(point): raise KeyError('lost')
experiment = dataclasses.replace(linksweep.core.experiment.link, check=check)
"""
PLACE = "published.file (line 15): 'published/table.csv'"
MINE = "experiment (line 1): 'mine.py:experiment': "
WITH_FILES = {  # by the content of a file beside the study: what is said
    CSV: [
        (b"v_max,sigma\n", f"{PLACE} holds no rows"),
        (b"v_max,colour,sigma_spin\n16,red,1\n", "columns ['colour'], which are neither parameters nor outputs"),
        (b"# c\nv_max,sigma_spin\n16,0.5\n17\n", "line 4: does not have 2 cells as the header has"),
        (b"v_max,sigma_spin\n16,0.5\n16.0,0.6\n", "line 3: sigma_spin: line 2 has a number for the same point"),
        (b"v_max,sigma_spin\n16," + b"1" * 200_000, "is not a CSV table: field larger than field limit"),
        (b"n_obj,sigma_spin\n2.5,1\n", "line 2: n_obj = 2.5: must be an integer"),  # an axis here, else a result
        (b"v_max\n\xff\n", "not UTF-8 text: byte 0xff in line 2"),
    ],
    "mine.py": [
        (b"raise RuntimeError('no licence')", f"{MINE}cannot be imported: RuntimeError: no licence"),
        (b"import sys; sys.exit(0)", f"{MINE}cannot be imported: SystemExit: 0"),
        (LOST, "check of a point raises KeyError: 'lost' (4 points)"),
    ],
}
CASES = {name: (text, phrase, {}) for name, (text, phrase) in STUDIES.items()}
for _name, _text in ((CSV, after(PUBLISHED)), ("mine.py", f'experiment = "mine.py:experiment"\n{GOOD}')):
    CASES |= {phrase: (_text, phrase, {_name: content}) for content, phrase in WITH_FILES[_name]}


@pytest.mark.parametrize("case", [slow(case) if case == "too many points" else case for case in CASES])
def test_bad_study(here, monkeypatch, case):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)  # or no __pycache__ would be written anyway
    text, phrase, files = CASES[case]
    write(here, files | {"study.toml": text.encode()})
    for command in ("run", "plan"):
        assert "study" in check_refused(here, (command, "study.toml"), phrase).splitlines()[0]


def test_all_problems_are_reported_in_one_message(here):
    text = 'title = 5\ncolour = "red"\n[axes]\nv_mx = [16.0]\nn_obj = []\n[fixed]\nerror_scale = -1.0\n'
    (here / "study.toml").write_text(f"{text}[sampling]\nn_sim = 0\n")
    places = ["title (line 1)", "colour (line 2)", "axes.v_mx (line 4)", "axes.n_obj (line 5)"]
    places += ["fixed.error_scale (line 7)", "sampling.n_sim (line 9)"]
    said = check_refused(here, ("run", "study.toml"), "error: study.toml: 6 problems\n")
    assert [line.partition(":")[0].removeprefix("  - ") for line in said.splitlines()[1:]] == places
    (here / "study.toml").write_bytes(b"\xef\xbb\xbf" + fixed("error_scale = -1").replace("\n", "\r\n").encode())
    options = ("--set", "seed", "--axis", "model=x")
    check_refused(here, ("run", "study.toml", *options), "3 problems", "--set 'seed'", "'x'", "line 8")


@pytest.fixture(scope="module")
def decayed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("decay")
    (folder / "decay.py").write_bytes(DECAY)
    axes = ("--axis", "years=1,2", "--axis", "half_life=3,4", "--set", "n_sim=5")
    assert run_sweep("run", "decay.py:decay", *axes, "-o", folder / "s.zarr", "--pool", "serial", cwd=folder)[0] == 0
    return folder / "s.zarr"


FILES = {"decay.py": DECAY, "decay.zarr/zarr.json": b"{}", "taken.toml": b"mine"}
FILES |= {"mine.py": b"def f(x: float):\n    return x\n", "c.toml": b'class = "distributed.LocalCluster"\nscale = 1\n'}
FILES["french.toml"] = GOOD.encode().replace(b"A good", b"\xc9tude")
FILES |= {"own/__init__.py": b"", "own/inner/__init__.py": b"", "own/inner/part.py": b"from ..other import unit\n"}
FILES["link.zarr/zarr.json"] = json.dumps(ROOT | {"attributes": {"result": "tie"}}).encode()
SOBOL = "plan quasars --design sobol:8"
ANOTHER = "STORE: , name it holds results of a different study, name it give another store with -o, name it experiment:"
COMMANDS = [
    ("run french.toml", "french.toml: not UTF-8 text: byte 0xc9 in line 1"),
    ("run mine.py --axis x=1", "mine.py: is Python, not a study, name it as mine.py:NAME"),
    (
        "run own/inner/part.py:f --axis x=1",
        "in a file is FILE.py:NAME; one of a package needs its folder in PYTHONPATH",
    ),
    ("run quasar", "no study 'quasar': neither a file nor a built-in study; did you mean 'quasars'?"),
    *((f"plan {'a' * 300}", "no study 'aaa"), ("plan /dev/zero", "/dev/zero: is larger than 1,000,000 bytes")),
    ("run /dev/null", "/dev/null: title: is required"),
    ("run study.toml --set n_sim", "--set 'n_sim': must be written KEY=VALUE"),
    ("run study.toml --set n_sim=-5", "sampling.n_sim (--set n_sim=-5): input should be greater than or equal to 1"),
    ("run study.toml --set weighting=equl", "weighting = 'equl': must be one of 'inverse-variance', 'equal'; did you"),
    ("run study.toml --axis v_max=14:16:", "axes.v_max (--axis v_max=14:16:): step = '': must be a finite number"),
    ("run mine.py:f --axis x=1:5", "--axis 'x=1:5': '1:5': a range is START:STOP:STEP, or START:STOP:log5; texts"),
    ("run study.toml --workers 0", "Invalid value for '--workers': 0 is not in the range 1<=x<=4096"),
    ("run study.toml --pool serial --workers 2", "workers = 2: pool serial has none"),
    ("run study.toml --retry --set seed=8", "--retry computes points of a store as it is"),
    ("run study.toml --retry", NOT_A_STORE),
    *((f"{command} study.toml -o STORE", ANOTHER) for command in ("run", "plan")),
    *((f"{one} link.zarr", "link.zarr: is a stored link, without points") for one in ("status", "check", "compare")),
    ("show STORE --json --format csv", "--json and --format csv are two formats; name one"),
    *(("compare STORE", "neither published numbers nor claims"), ("fit STORE --law levelling --expect 1", "--expect")),
    ("fit STORE --at metal=lead", "metal = lead is not in the grid, which has gold, tin"),
    ("find STORE --where share=1", "--where: 'share=1': a condition is VARIABLE, one of < <= > >="),
    *(("tie psrpi nowhere.fits", "nowhere.fits: no such file"), ("tie psrpi icrf3", "within 1 arcsec")),
    *(("tie psrpi icrf4", "did you mean 'icrf3'?"), ("tie psrpi psrpi --unknowns spinn", "'spinn' are not known")),
    ("tie psrpi psrpi --column ra", "must be [TABLE:]KEY=COLUMN"),
    ("tie psrpi psrpi -o out.nc", "must end with .zarr, .png"),
    ("tie icrf3 icrf2 --unknowns spin", "nothing in the tables determines omega_x"),
    ("tie psrpi psrpi --mission spin=psrpi", "none of the unknowns"),
    ("tie psrpi psrpi --mission a=psrpi --mission a=psrpi", "named twice"),
    ("tie psrpi psrpi --mission a=psrpi --mission-epoch b=1991.25", "no table 'b'"),
    ("tie psrpi psrpi --mission a=psrpi --jitter b:position=1", "no table 'b'"),
    ("reproduce STORE --at metal=tin", "coins needs a value, one of 1, 5, 20"),
    ("reproduce STORE --at metall=tin,coins=6", "'metall' is not an axis; did you mean 'metal'?"),
    ("reproduce STORE --at tin", "'tin': a place is AXIS=VALUE"),
    *(("scaling sqrt-n --workers 2,4", "must increase from 1"), ("scaling sqrt-n --workers 1,5000", "4096")),
    ("scaling sqrt-n --workers 1,two", "'1,two' is no list of numbers of workers; write 1,2,4"),
    *(("scaling sqrt-n --set n_sim=none", "n_sim"), ("scaling sqrt-n --set precision=0.1", "decides itself")),
    *(("scaling sqrt-n --repetitions 0", "repetitions"), ("scaling sqrt-n -o s.txt", "the name must end")),
    # no option is dropped for another
    ("plan quasars --axis v_max=14,15 --set v_max=16", "--set v_max=16 and --axis v_max=14,15: v_max is"),
    ("plan quasars --axis v_max=14,15 --axis v_max=16", "--axis v_max=14,15 and --axis v_max=16: v_max is given twice"),
    ("plan quasars --set n_sim=1 --set sampling.n_sim=2", "--set n_sim=1 and --set sampling.n_sim=2: n_sim is given"),
    ("plan quasars --design random:8 --range v_max=1:5 --range v_max=1:6", "--range v_max=1:5 and --range v_max=1:6"),
    (f"{SOBOL}:3 --range v_max=14:15 --set points.seed=4", "--set points.seed=4 and --design sobol:8:3:"),
    ("plan quasars --points t.csv --range v_max=14:15 --set points.seed=4", "t.csv): ranges, seed: does not"),
    (f"{SOBOL} --range v_mxa=14:15", "points.ranges.v_mxa (--range v_mxa=14:15): unknown"),
    (f"{SOBOL} --range error_scale=2:1e305", "(--range error_scale=2:1e305): high = 1e+305: must"),
    ("plan quasars --design sobl:8 --range v_max=14:15", "points.design (--design sobl:8): input should be 'sobol'"),
    (f"{SOBOL}:3:1 --range v_max=14:15", "--design 'sobol:8:3:1': must be written NAME:N or NAME:N:SEED"),
    ("plan quasars --axis model=amex,[gaia,x]", "commas divide values"),
    (f"{SOBOL} --range model='c,d',a", "commas divide values"),
    ("run study.toml --cluster c.toml --memory-limit 2GB", "memory and cluster are for different places"),
    ("run study.toml --cluster c.toml --tls-ca c.toml", "--tls-ca, --tls-cert and --tls-key"),
    *(("run study.toml --log study.toml", "is no file of --log"), ("run grid --events decay.py", "file of --events")),
    *((f"run grid --events decay.zarr/{name}", "lies inside the store") for name in ("zarr.json", "e.jsonl")),
    *(("new taken.toml", "taken.toml: exists already"), ("new ../up", "'../up' is no name for a study")),
    *(("new fine no.such:thing", "no.such"), ("new fine math:tau", "math:tau")),
    ("plot STORE --kind map", "a map needs two axes of numbers that are crossed, not coins; there are coins"),
    ("plot STORE --over length", "share cannot be drawn along length; its axes are"),
    ("check STORE --break-lock", "--break-lock goes with --repair"),
    ("plot STORE --kind sky", "no sky and no accuracy here: only studies of the link"),
    ("plot STORE --kind sky --over coins", "do not go with --kind sky"),
    *((f"plot STORE --width {w}", "must be from 40mm to 1000mm, like 88mm or 180mm") for w in ("2mm", "wide")),
    *(("plot", "name the store to draw"), ("plot --kind accuracy --model hipparcos", "no model 'hipparcos'")),
    ("plot STORE --log coinz", "'coinz' has no scale to choose; did you mean 'coins'?"),
    ("plot STORE --log coins --linear coins", "coins cannot have both a logarithmic and a linear axis"),
    ("plot STORE --kind law --at metal=tin --linear coins", "a law is drawn on logarithmic"),
    *(("report STORE --all", "name stores, or give --all"), ("report STORE --workers 2", "go with --all")),
    *((f"report STORE -o {path}", "must end with .html or .htm") for path in ("study.toml", ".")),
    # typical mistakes, with what solves them
    *(("run quasars --set n_sims=4", "'n_sim'"), ("run quasars --axis n_sim=4,5", "--set n_sim=")),
    *(("run quasars.toml", "'quasars'"), ("run decay", "'decay.py'"), ("show decay", "'decay.zarr'")),
    *(("run decay.zarr", "sweep run --retry"), ("plot decay.zarr --kind heatmap", "did you mean 'map'?")),
    ("run decay.py:decay --axis years 1,2", "--axis NAME=1,2,3"),
    ("run decay.py:decay --axis years=1,2 --set half_life=2 --seed 4", "--set NAME=VALUE"),
    ("run decay.py:decay --axis years=1,2", "--set half_life=VALUE"),
    *(("show DECAYED --at year=1", "'years'"), ("fit DECAYED", "--over")),
    *(("plot DECAYED --at years=3", "which has 1, 2"), ("find DECAYED", "--where"), ("plot DECAYED --logy", "'--log'")),
]


@pytest.mark.parametrize(("command", "phrase"), COMMANDS, ids=lambda value: value[:60])
def test_a_command_that_cannot_be_run_says_why(here, coin_store, decayed, command, phrase):
    write(here, FILES)
    stores = {"STORE": coin_store, "DECAYED": decayed}
    words = [stores.get(word, word) for word in command.split()]
    check_refused(here, words, *phrase.replace("STORE", str(coin_store)).split(", name it "))


@pytest.mark.parametrize("address", [*NO_ADDRESSES, "tcp://127.0.0.1:1", slow("tcp://127.0.0.1:99999999")])
def test_bad_scheduler(here, monkeypatch, address):
    monkeypatch.setattr("linksweep.sweep.executing.clusters.CONNECT_TIMEOUT_S", 0.2)
    words = "expected tcp://HOST:PORT" if address in NO_ADDRESSES else "no Dask scheduler answers"
    check_refused(here, ("run", "study.toml", "--scheduler", address), words, repr(address))


@pytest.mark.parametrize("case", FOREIGN)
def test_something_else_where_the_store_should_be(here, case):
    files, phrase = FOREIGN[case]
    write(here, {f"s.zarr/{name}".rstrip("/"): content.encode() for name, content in files.items()})
    if (here / "s.zarr").is_dir():
        (here / "s.zarr" / "link").symlink_to("thesis.txt")  # not for us to look at
    for command in (("run", "study.toml", "-o"), ("plan", "study.toml", "-o"), ("show",), ("status",)):
        check_refused(here, (*command, "s.zarr"), "s.zarr: ", phrase)


def test_places_where_no_store_is_or_can_be(here):
    for command in ("show", "status"):
        check_refused(here, (command, "results/missing.zarr"), "results/missing.zarr: no store there")
        check_refused(here, (command, "n" * 300), "nnn")
    for path in ("loop.zarr", "moved.zarr"):
        (here / path).symlink_to(path.replace("moved", "away"))
    for folder in ("closed", "held.zarr.lock", "gone"):
        (here / folder).mkdir()
    moved = f"moved.zarr: {NOT_A_STORE}"
    for path, said in (("moved.zarr", moved), ("closed", "closed: no store there: the folder is empty")):
        check_refused(here, ("show", path), said)
    places = [("plan", "n" * 300, "nnn"), ("plan", f"{'n' * 300}/s.zarr", "nnn"), ("run", "loop.zarr", "loop.zarr")]
    places += [("run", "moved.zarr", moved), ("plan", "moved.zarr", moved)]
    places += [("run", "held.zarr", "held.zarr: cannot be written: held.zarr.lock: Is a directory")]
    places += [("run", "study.toml/s.zarr", "study.toml/s.zarr: cannot be written: ")]
    for command, path, said in places:
        check_refused(here, (command, "study.toml", "-o", path), said)
    command = ["sh", "-c", f"cd gone; rmdir ../gone; exec {sys.executable} -m linksweep run quasars"]
    said = "error: the present folder was removed; change to another one\n"
    assert subprocess.run(command, check=False, capture_output=True, text=True).stderr == said
