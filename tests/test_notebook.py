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


def data(shown):
    return {kind for output in shown if "data" in output for kind in output["data"]}


def test_cells_of_the_page_on_every_pool_with_a_mistake_and_with_other_code(tmp_path):
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
    assert error["traceback"] == [f"SweepError: {error['evalue']}"]
    assert "rte" in error["evalue"]
    [error] = [output for output in other_code if output["output_type"] == "error"]
    words = "value __main__.scale is 2.0 in the store, 3.0 now", "accept_code=True"
    assert (error["ename"], all(one in error["evalue"] for one in words)) == ("SweepError", True)
