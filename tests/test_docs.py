"""What the documents show is true: their files and commands are run as they stand there."""

import ast
import doctest
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from contextlib import closing
from importlib import import_module

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep.sweep.executing.clusters import cluster_class, own_cluster, read_cluster_file
from tests.documents import ROOT, code, commands, run_commands, save_files
from tests.sweep.executing.test_clusters import tls_files
from tests.sweep.outside import Outside
from tests.test_imports import FILES
from tests.tiers import PATIENCE_S

# The pages whose commands need nothing from elsewhere.  Others are run below (clusters), and by the tests of the
# tutorial, stores and galaxies.
PAGES = """
    analysis benchmarks calibration coming-from dr4 experiments function-package function-quantile function-series
    gallery missions planning-observations points refine report running studies watch tie
""".split()  # noqa: SIM905
ALSO = {"dr4": "figures/solution.png", "report": "quasars-report.html", "watch": "results/quasars.zarr/zarr.json"}
ALSO |= {"tie": "icrf-figures/spectrum.png"}
"""A file that a page's commands write without its name in them."""

FIRST_IS_FILE = {"points.md": "flow.py", "refine.md": "shapes.py"}
SCRIPTS = [*FIRST_IS_FILE, "clusters.md", "dr4.md", "functions.md", "planning-observations.md", "results.md", "tie.md"]
SHOWN = [(document, 0, 0) for document in ("tie.md", "planning-observations.md", "dr4.md", "tie-science.md")]
SHOWN += [("planning-observations.md", 3, 1), ("tie-science.md", 1, 1)]
MODULES = [f"linksweep.{name}".removesuffix(".__init__") for name, path in FILES.items() if ">>> " in path.read_text()]
ON_POOLS = """
for pool in ("serial", "threads", "processes"):
    on = linksweep.run(growth, axes={"rate": [0.0, 0.1]}, store=f"{pool}.zarr", pool=pool, progress=False)
    print(pool, on.end.values.tolist() == [growth(r)["end"] for r in (0.0, 0.1)])
"""
MISTAKE = """linksweep.run(growth, axes={"rte": [0.0]})"""
OTHER_CODE = """
scale = 3.0
linksweep.run(growth, axes={"rate": [0.0, 0.1]}, store="serial.zarr", pool="serial", progress=False)
"""


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run_and_write_what_it_shows(page, tmp_path, sweep):
    document = f"{page}.md"
    save_files(document, tmp_path)
    if page in ("missions", "studies"):  # which show a study without a command
        (tmp_path / f"{page}.toml").write_text(code(document, "toml")[0])
        sweep("run", f"{page}.toml", "--set", "n_sim=10", cwd=tmp_path, code=0)
    run_commands(document, sweep, tmp_path)
    words = " ".join([*commands(document), ALSO.get(page, "")])
    for name in re.findall(r"\S+\.(?:svg|png|pdf|html|json|log)\b", words):
        assert (tmp_path / name).stat().st_size > 1000, name
    if page == "experiments":
        distance = xr.open_zarr(tmp_path / "results" / "walk.zarr")["distance"].load()
        for length in (10, 100, 1000):  # RMS of 5000 walks: 1/sqrt(2 x 5000) = 1 %
            assert distance.sel(length=length).item() == pytest.approx(length**0.5, rel=0.05)
    if page == "function-series":
        ds = xr.open_zarr(tmp_path / "sir.zarr")
        assert ds.infected.dims == ("beta", "time")
        assert ds.peak.values.tolist() == ds.infected.max("time").values.tolist()
        (pair,) = re.findall(r"`(linksweep\.run\(sir.*?)`", (ROOT / "docs" / "functions.md").read_text())
        sweep(*shlex.split(commands("functions.md")[0])[1:-1], "pair.zarr", cwd=tmp_path, code=0)
        python(tmp_path, "-c", f"import linksweep\nfrom sir import sir\n{pair.replace('sir.zarr', 'pair.zarr')}")
        assert xr.open_zarr(tmp_path / "pair.zarr").beta.values.tolist() == [k / 20 for k in range(2, 11)]
    if page == "points":
        sizes = [xr.open_zarr(tmp_path / name).sizes["point"] for name in ("flow.zarr", "both.zarr")]
        assert sizes == [128, 3]  # at two values of hl


def python(folder, *arguments):
    command = [sys.executable, "-W", "error::DeprecationWarning", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("document", SCRIPTS)
def test_the_scripts_of_a_page_run(document, tmp_path):
    blocks = code(document, "python")
    if document in FIRST_IS_FILE:
        (tmp_path / FIRST_IS_FILE[document]).write_text(blocks.pop(0))
    for block in blocks:
        python(tmp_path, "-c", block)
    assert len(list(tmp_path.iterdir())) > (document in FIRST_IS_FILE)


@pytest.mark.slow
def test_the_tutorial_from_top_to_bottom(tmp_path, sweep):
    """Files are saved, commands and scripts run where they stand, and the text says what they print."""
    text, printed = (ROOT / "docs" / "tutorial.md").read_text(), {}
    for language, file, block in re.findall(r"```(\w+|\{picture\})(?: (\S+))?\n(.*?)```", text, re.DOTALL):
        if file:
            (tmp_path / file).write_text(block)
        elif language == "python":
            (tmp_path / "script.py").write_text(block)
            printed["script"] = python(tmp_path, "script.py")
        for words in (shlex.split(line, comments=True)[1:] for line in block.splitlines() if line[:6] == "sweep "):
            printed[" ".join(words[:2])] = sweep(*words, cwd=tmp_path, code=0)[1]
    names = ["demo", "elsewhere", "first", "mission", "pi", "precise"]
    assert sorted(path.stem for path in (tmp_path / "results").glob("*.zarr")) == names
    for name in ("demo.svg", "demo.html", "first.svg", "curves.svg", "spin.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert printed["run demo.toml"].endswith(re.search(r"```text\n(.*?)```", text, flags=re.DOTALL)[1])
    fit = printed["fit results/first.zarr"]
    amex, gaia = (float(re.search(rf"{model} .*?(-0\.\d+) ±", fit)[1]) for model in ("amex", "gaia"))
    assert f"is {gaia:.2f} for\nGAIA" in text
    assert f"{amex:.2f} for AMEX" in text
    assert "2 of 2 lines: the law does not hold" in fit
    steep, even = map(float, re.findall(r"-0\.\d+", printed["script"]))
    assert -0.8 < steep < -0.52
    assert even == pytest.approx(-0.5, abs=0.05)
    mission, pi = (xr.open_zarr(tmp_path / "results" / name).load() for name in ("mission.zarr", "pi.zarr"))
    ratio = mission.sigma_spin.sel(model="half") / mission.sigma_spin.sel(model="gaia")
    assert ratio.values == pytest.approx(0.5, rel=0.1)
    assert pi.share.sel(side=1.0).item() == pytest.approx(np.pi / 4, abs=4 * 0.41 / 20000**0.5)


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["linksweep", "xyzpy", "pipefunc", "hydra", "snakemake"])
def test_the_same_sweep_with_each_tool_gives_the_same_numbers(tool, tmp_path):
    pytest.importorskip(tool)
    text = save_files("coming-from.md", tmp_path)
    scripts = code("coming-from.md", "python")
    script = next((one for one in scripts if f"import {tool}" in one or f"from {tool}" in one), "")
    script += 'print({"half_life": ds.half_life.values.tolist(), "lost": ds.lost.values.astype(float).tolist()})'
    hydra = shlex.split(re.search(r"`python (lost_hydra.py .*?)`", text)[1])
    others = {"hydra": hydra, "snakemake": ["-m", "snakemake", "--cores", "1"]}
    said = python(tmp_path, *others.get(tool, ["-c", script]))
    if tool in others:
        results = [json.loads(file.read_text()) for file in tmp_path.rglob("*.json") if "lost" in file.read_text()]
        got = {(one["half_life"], one["years"]): one["lost"] for one in results if "half_life" in one}
    else:
        printed = ast.literal_eval(said.splitlines()[-1])
        pairs = zip(printed["half_life"], printed["lost"], strict=True)
        got = {(h, years): value for h, row in pairs for years, value in zip((5, 10), row, strict=True)}
    assert got == {(h, y): 1.0 - 0.5 ** (y / h) for h in (1.0, 2.0, 5.0, 10.0) for y in (5, 10)}


@pytest.mark.parametrize(("document", "command", "text"), SHOWN)
def test_the_numbers_of_real_tables_are_those_that_are_printed(document, command, text, tmp_path, sweep):
    out = sweep(*shlex.split(commands(document)[command])[1:], cwd=tmp_path, code=0)[1]
    shown = [line for line in code(document, "text")[text].splitlines() if re.search(r"\d\.\d{5}", line)]
    assert len(shown) >= 3
    assert set(shown) <= set(out.splitlines())


def test_the_readme_shows_the_table_that_the_study_prints_and_its_functions_run(tmp_path, sweep):
    table = re.search(r"```text\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)[1]
    out = sweep("run", "quasars", "--axis", "v_max=14,14.5", "-o", tmp_path / "s.zarr", code=0)[1]
    printed = [line.split() for line in out.splitlines() if line.split()[:1] in (["amex"], ["gaia"])]
    assert len(printed) == 4
    assert all(row in [line.split() for line in table.splitlines()] for row in printed)
    text = (ROOT / "README.md").read_text()
    (example,) = re.findall(r"```python\n(def birthday.*?)```", text, flags=re.DOTALL)
    (tmp_path / "birthday.py").write_text(example)
    for command in re.findall(r"^sweep .*birthday.*$", text, flags=re.MULTILINE):
        sweep(*shlex.split(command)[1:], cwd=tmp_path, code=0)
    shared = xr.open_zarr(tmp_path / "birthday.zarr")["shared_mean"].load()
    people = shared.people.values
    alone = [np.prod(1.0 - np.arange(n) / 365.0) for n in people]  # all birthdays differ
    np.testing.assert_allclose(shared, 1.0 - np.array(alone), atol=0.05)


@pytest.mark.slow
def test_the_commands_about_clusters_run(tmp_path, sweep):
    (tmp_path / "dask").mkdir()
    (tmp_path / "cluster.toml").write_text(code("clusters.md", "toml")[0])
    files = tls_files(tmp_path / "tls")
    here = dict(zip(("ca.pem", "me.pem", "key.pem"), files[1::2], strict=True))
    secured = Outside(tmp_path / "tls", "--tls-ca-file", *files[1:], protocol="tls")
    with closing(secured), closing(Outside(tmp_path / "dask")) as plain:
        for outside in (plain, secured):
            outside.start_worker()
            here[f"{outside.address[:3]}://head.example.org:8786"] = outside.address
        for command in commands("clusters.md"):
            sweep(*(here.get(word, word) for word in shlex.split(command)[1:]), cwd=tmp_path, code=0)


@pytest.mark.slow
def test_the_batch_systems_of_the_document_get_their_jobs(tmp_path):
    """The files make job scripts; a real SLURM runs one like the first in test_slurm."""
    shown = {"slurm.toml": code("clusters.md", "toml")[1], "pbs.yaml": code("clusters.md", "yaml")[0]}
    said = {"slurm.toml": ["#SBATCH -p short", "#SBATCH --account=astro"]}
    said["pbs.yaml"] = ["#PBS -l select=1:ncpus=8:mem=16GB", "--nworkers 8"]
    for name, text in shown.items():
        (tmp_path / name).write_text(text)
        file = read_cluster_file(tmp_path / name)
        with own_cluster(cluster_class(file.class_name), file.options) as cluster:
            assert all(words in cluster.job_script() for words in said[name])


def test_pages_link_to_what_is_there_list_every_page_name_and_extra_and_the_reference_is_in_step_with_the_code():
    pages = {path.name: path.read_text() for path in (ROOT / "docs").glob("*.md")}
    for name, text in {"../README.md": (ROOT / "README.md").read_text(), **pages}.items():
        for target in re.findall(r"\]\(([^)#]+)\)", text):
            assert target.startswith("https://") or ((ROOT / "docs" / name).parent / target).exists(), (name, target)
    _, *groups = re.split(r"^## ", pages["index.md"], flags=re.MULTILINE)  # of which docs/conf.py makes the sidebar
    assert [group.splitlines()[0] for group in groups] == ["Tutorials", "How-to guides", "Reference", "Explanation"]
    assert sorted(re.findall(r"\]\(([\w-]+\.md)\)", "".join(groups))) == sorted(pages.keys() - {"index.md"})
    listed = re.findall(r"^\.\. auto\w+:: (\w+)", pages["api.md"], flags=re.MULTILINE)
    assert sorted(set(listed) - {"linksweep"}) == sorted(linksweep.__all__)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    table = re.findall(r"^\| (`.*?) \|", pages["install.md"], flags=re.MULTILINE)
    assert sorted(re.findall(r"`([\w-]+)`", " ".join(table))) == sorted(project["optional-dependencies"])
    made = runpy.run_path(str(ROOT / "docs" / "make_reference.py"))["reference"]()
    assert (ROOT / "docs" / "reference.md").read_text(encoding="utf-8") == made, "run `python docs/make_reference.py`"


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_run(name, here):
    results = doctest.testmod(import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert results.attempted
    assert not results.failed


def data(shown):
    return {kind for output in shown if "data" in output for kind in output["data"]}


@pytest.mark.slow
def test_cells_of_the_notebook_page_on_every_pool_with_a_mistake_and_with_other_code(tmp_path):
    pytest.importorskip("ipykernel")
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    sources = [*code("function-notebook.md", "python"), ON_POOLS, MISTAKE, OTHER_CODE]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources])
    kernel = tmp_path / "kernels" / "here"
    kernel.mkdir(parents=True)
    start = f'["{sys.executable}", "-m", "ipykernel_launcher", "-f", "{{connection_file}}"]'
    (kernel / "kernel.json").write_text(f'{{"argv": {start}, "display_name": "here", "language": "python"}}')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JUPYTER_PATH", str(tmp_path))
        patch.delenv("PYTHONWARNINGS", raising=False)
        options = {"kernel_name": "here", "timeout": int(PATIENCE_S), "allow_errors": True}
        resources = {"metadata": {"path": str(tmp_path)}}
        nbclient.NotebookClient(notebook, resources=resources, **options).execute()
    *page, on_pools, mistake, other_code = [cell.outputs for cell in notebook.cells]
    results, answer, picture, more, *_ = page
    assert not [output for output in (*results, *answer, *picture, *more) if output["output_type"] == "error"]
    assert "text/html" in data(results) & data(answer)
    assert "image/png" in data(picture)
    said = "".join(output["text"] for output in on_pools if output["output_type"] == "stream")
    assert said.split() == ["serial", "True", "threads", "True", "processes", "True"]
    [error] = mistake
    assert (error["traceback"], "rte" in error["evalue"]) == ([f"SweepError: {error['evalue']}"], True)
    [error] = [output for output in other_code if output["output_type"] == "error"]
    words = "value __main__.scale is 2.0 in the store, 3.0 now", "accept_code=True"
    assert (error["ename"], all(one in error["evalue"] for one in words)) == ("SweepError", True)
