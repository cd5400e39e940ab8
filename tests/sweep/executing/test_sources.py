"""The sources of an experiment travel to workers that do not share its folder."""

import os
import shutil
import subprocess
from contextlib import closing

import pytest

from tests.sweep.opening import open_dataset
from tests.sweep.outside import Outside
from tests.sweep.user import write_experiment, write_study


@pytest.fixture
def study(tmp_path):
    """The folder of a study whose experiment imports a helper beside it."""
    folder = tmp_path / "mine"
    write_experiment(
        folder, before="import helper", evaluate='{"total": [n_sim * helper.FACTOR * p["rate"] for p in points]}'
    )
    (folder / "helper.py").write_text("FACTOR = 5.0\n")
    write_study(folder)
    return folder


def test_workers_without_the_folder_compute_with_its_helpers(study, tmp_path, sweep):
    """The worker has an empty file system mounted where the client has the study, and neither sees the other's."""
    hide = ["unshare", "--mount", "sh", "-c", f'mount -t tmpfs none "{study}" && test ! -e "{study}/user.py" && "$@"']
    if (
        os.geteuid() != 0
        or not shutil.which("unshare")
        or subprocess.run([*hide, "sh", "true"], check=False).returncode
    ):
        pytest.skip("a file system of its own for a process needs root and unshare")
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask")) as outside:
        outside.start_worker(before=[*hide, "sh"])
        code, out, err = sweep("run", "s.toml", "-o", "s.zarr", "--scheduler", outside.address, cwd=study)
    assert code == 0, err
    assert open_dataset(study / "s.zarr")["mean"].values.tolist() == [5.0, 10.0], out
