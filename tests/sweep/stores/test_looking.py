"""Looking at a store runs nothing that it names; computing from a stranger's store asks first."""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.conftest import main
from tests.sweep.opening import forge, places_in, replaced, run, sealed

COINS = (Path(__file__).parents[1] / "coins.py").read_text()
MARKING = 'from pathlib import Path\nPath({marker!r}).write_text("was here")\n'
COMPUTING = {"merge", "reproduce"}
"""Commands that need the code of a store, and ask."""

RETRY = ["--retry", "STORE"]
ONE, STUDY_TOO = [["STORE"]], [["STORE"], ["STORE/study.toml"]]
ARGUMENTS = {  # by command: what a user would type about a store, several times where there are several ways
    **dict.fromkeys(("compare", "report", "sensitivity", "watch"), ONE),
    **dict.fromkeys(("plan", "scaling"), STUDY_TOO),
    **{"list": [[]], "new": [["mine", "STORE"]], "params": [*ONE, ["STORE", "--schema"]], "run": [*STUDY_TOO, RETRY]},
    **{"check": [*ONE, ["STORE", "--repair"]], "status": [*ONE, ["STORE", "--json"]]},
    **{"match": [["STORE", "STORE"]], "forecast": [["STORE", "STORE"]], "tie": [["STORE", "zero-motion"]]},
    **{"show": [*ONE, ["STORE", "--format", "csv"]], "merge": [["STORE", "STORE", "-o", "STORE.merged"]]},
    "apply": [["STORE", "psrpi-de200", "-o", "STORE.csv"]],
    **{"find": [["STORE", "--where", "share < 0.5", "--over", "coins"]], "fit": [["STORE", "--over", "coins"]]},
    "plot": [*ONE, *(["STORE", "--kind", kind] for kind in ("sky", "accuracy", "map"))],
    "refine": [[*words, "--until", "error < 0.1"] for words in STUDY_TOO],
    **{"reproduce": [["STORE", "--at", "metal=tin,coins=1"]], "submit": [["STORE/study.toml", "--slurm", "2"]]},
}
STUDY = 'title = "Coins"\nexperiment = "x.py:experiment"\naxes = { coins = [1, 5] }\nsampling = { n_sim = 100 }\n'
# Keys that a study or a store may have, where a reference could be put
ADDED = ("derive", "file", "define", "experiment", "catalogue", "published", "figure", "code", "function", "columns")
BESIDE = [  # where a study has references
    *[("points", "derive"), ("points", "file"), ("define", "metal", "mine", "curve"), ("published", "file")],
    *[("figure", "kind"), ("fixed", "metal"), ("axes", "metal"), ("sampling", "seed")],
]
LOOKING = ["status STORE", "show STORE", "check STORE", "plot STORE --kind sky", "report STORE"]
INTERESTING = ("study", "experiment", "record", "point", "define", "claims", "conclusion", *ADDED)


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    place = tmp_path_factory.mktemp("elsewhere")
    code = MARKING.format(marker=str(place / "marker")) + COINS
    (place / "x.py").write_text(code)
    axes = {"metal": ["gold", "tin"], "coins": [1, 5, 20]}
    document = {"title": "Coins", "experiment": f"{place / 'x.py'}:experiment", "axes": axes}
    run(document | {"fixed": {"chance": 0.4}, "sampling": {"n_sim": 100, "n_cat": 2}}, place / "g.zarr")
    return place, code


@pytest.fixture
def evil(tmp_path_factory, honest):
    """A store whose code lies inside it, by a link, and leaves a marker when it is imported, and the marker."""
    (place, code), here = honest, tmp_path_factory.mktemp("here")  # each time another: code is imported once from one
    shutil.copytree(place / "g.zarr", store := here / "g.zarr")
    (here / "l").symlink_to(store)
    forge(store, lambda root: root.update(study_document=root["study_document"].replace(str(place), f"{here}/l")))
    (store / "x.py").write_text(code)
    (store / "study.toml").write_text(STUDY)
    (place / "marker").unlink(missing_ok=True)
    return store, place / "marker"


def test_every_command_is_tried():
    assert set(ARGUMENTS) == set(main.list_commands(None)), "say above how a new command looks at a store"


@pytest.mark.parametrize("command", sorted(ARGUMENTS))
def test_no_command_runs_what_a_store_names(evil, sweep, tmp_path, command):
    store, marker = evil
    for arguments in ARGUMENTS[command]:
        code, _, err = sweep(command, *(a.replace("STORE", str(store)) for a in arguments), cwd=tmp_path)
        assert not marker.exists(), arguments
        assert "Traceback" not in err, err
        if command in COMPUTING or arguments in (["STORE/study.toml"], RETRY):
            assert (code, "--trust" in err, str(store) in err) == (2, True, True)
    if command in COMPUTING or command == "run":
        assert f"would run {store.parent}/l/x.py, which lies inside the store" in err
        sweep(command, *(a.replace("STORE", str(store)) for a in ARGUMENTS[command][-1]), "--trust", code=0)
        assert marker.exists()


def test_a_store_from_elsewhere_asks_and_so_do_its_functions(coin_store, tmp_path, coins, sweep, monkeypatch, store_of):
    (tmp_path / "x.py").write_text(COINS)
    run(coins | {"experiment": f"{tmp_path / 'x.py'}:experiment"}, tmp_path / "s.zarr")
    point, copy = ("--at", "metal=tin,coins=5"), tmp_path / "copy.zarr"
    shutil.copytree(tmp_path / "s.zarr", copy)
    assert sweep("reproduce", tmp_path / "s.zarr", *point)[0] == 0  # written here: nothing to ask
    words = r"would run .*x.py, and the store was not written here: .* give --trust"
    assert re.search(words, sweep("reproduce", copy, *point, code=2)[2])
    for command in (("reproduce", copy, *point), ("run", "--retry", copy)):
        assert sweep(*command, "--trust")[0] == 0
    assert sweep("reproduce", copy, *point)[0] == 0  # written here since
    for who in ("platform.node", "getpass.getuser"):  # another host or user is elsewhere
        with monkeypatch.context() as patch:
            patch.setattr(who, lambda: "another")
            assert "coins.py, and the store was not written here" in sweep("reproduce", coin_store, *point, code=2)[2]
    store = tmp_path / "q.zarr"
    shutil.copytree(store_of("quasars"), store)
    point = ("reproduce", store, "--at", "model=gaia,v_max=14")
    assert sweep(*point)[0] == 0

    def define(attributes):
        document = json.loads(attributes["study_document"])
        document["define"] = {"model": {"mine": {"sigma_pm": str(tmp_path / "m.py") + ":curve"}}}
        attributes["study_document"] = json.dumps(document)

    forge(store, define)
    assert re.search(r"would run .*m.py, and the store was not written here", sweep(*point, code=2)[2])


@pytest.mark.slow
def test_no_field_of_any_document_is_a_way_to_run_code(evil, here, monkeypatch, sweep):
    store, marker = evil
    (here / "evilmodule.py").write_text((store / "x.py").read_text())
    monkeypatch.syspath_prepend(here)
    documents = {file: json.loads((store / file).read_text()) for file in ("zarr.json", "blocks/zarr.json")}
    every = [(file, path) for file, document in documents.items() for path in places_in(document)]
    places = [one for one in every if any(word in str(part) for part in one[1] for word in INTERESTING)]
    added = [("zarr.json", ("attributes", "study_document", None, *inner)) for inner in BESIDE]
    ends = [(file, path) for file, path in places if path[-1] in ("study_document", None, "points")]
    added += [(file, (*path, key)) for file, path in ends for key in ADDED]
    for number, (file, path) in enumerate(places + [one for one in added if len(one[1]) < 6]):
        reference = (f"{store}/x.py:experiment", "evilmodule:experiment")[number % 2]
        try:
            forged = replaced(documents[file], path, reference)
        except (KeyError, TypeError, IndexError, AttributeError, ValueError):
            continue  # nothing can be put there
        (store / file).write_bytes(sealed(forged, file))
        for line in (LOOKING[number % len(LOOKING)], LOOKING[0]):
            sweep(*line.replace("STORE", str(store)).split())
            assert not marker.exists(), (file, path, line)
        (store / file).write_bytes(sealed(documents[file], file))
