"""The page on notebooks in a real Jupyter kernel, on every pool."""

import sys

import pytest

from tests.test_docs import code
from tests.tiers import PATIENCE_S

pytestmark = pytest.mark.slow

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


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """What each cell of the page, and of `ON_POOLS`, `MISTAKE` and `OTHER_CODE`, shows in a kernel."""
    pytest.importorskip("ipykernel")
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    folder = tmp_path_factory.mktemp("notebook")
    sources = [*code("function-notebook.md", "python"), ON_POOLS, MISTAKE, OTHER_CODE]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in sources])
    kernel = folder / "kernels" / "here"
    kernel.mkdir(parents=True)
    start = f'["{sys.executable}", "-m", "ipykernel_launcher", "-f", "{{connection_file}}"]'
    (kernel / "kernel.json").write_text(f'{{"argv": {start}, "display_name": "here", "language": "python"}}')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JUPYTER_PATH", str(folder))
        patch.delenv("PYTHONWARNINGS", raising=False)
        resources = {"metadata": {"path": str(folder)}}
        nbclient.NotebookClient(
            notebook, kernel_name="here", timeout=int(PATIENCE_S), allow_errors=True, resources=resources
        ).execute()
    return [cell.outputs for cell in notebook.cells]


def data(shown):
    return {kind for output in shown if "data" in output for kind in output["data"]}


def said(shown):
    return "".join(output["text"] for output in shown if output["output_type"] == "stream")


def test_cells_show_datasets_and_pictures(outputs):
    results, answer, picture, more, *_ = outputs
    assert not [output for output in (*results, *answer, *picture, *more) if output["output_type"] == "error"]
    assert "text/html" in data(results)
    assert "text/html" in data(answer)
    assert "image/png" in data(picture)


def test_a_function_of_a_cell_runs_on_every_pool(outputs):
    assert said(outputs[-3]).split() == ["serial", "True", "threads", "True", "processes", "True"]


def test_changed_code_is_refused_in_words_of_python(outputs):
    [error] = [output for output in outputs[-1] if output["output_type"] == "error"]
    assert error["ename"] == "SweepError"
    assert "value __main__.scale is 2.0 in the store, 3.0 now" in error["evalue"]
    assert "accept_code=True" in error["evalue"]


def test_a_mistake_is_shown_as_its_sentence(outputs):
    [error] = outputs[-2]
    [sentence] = error["traceback"]
    assert sentence == f"SweepError: {error['evalue']}"
    assert "rte" in sentence
