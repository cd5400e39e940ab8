"""Clusters that a file describes."""

import pytest
import xarray as xr

from tests.tiers import slow

LOCAL = 'class = "distributed.LocalCluster"\n'
WORKERS = "[options]\nn_workers = 0\nthreads_per_worker = 1\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("fixed.toml", LOCAL + "scale = 1\n" + WORKERS),
        slow("two.toml", LOCAL + "scale = 2\n" + WORKERS),
        pytest.param(
            "adaptive.toml", LOCAL + "adapt = { minimum = 0, maximum = 2 }\n" + WORKERS, marks=pytest.mark.slow
        ),
        pytest.param(
            "threads.toml",
            LOCAL + "adapt = { minimum = 1, maximum = 2 }\n" + WORKERS + "processes = false\n",
            marks=pytest.mark.slow,
        ),
        slow(
            "adaptive.yaml",
            "class: distributed.LocalCluster\nadapt: {minimum: 0, maximum: 2}\n"
            "options: {n_workers: 0, threads_per_worker: 1}\n",
        ),
    ],
)
def test_a_study_runs_on_the_cluster_of_a_file(link_study, tmp_path, sweep, reference, name, text):
    (tmp_path / name).write_text(text)
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", tmp_path / name, cwd=tmp_path)
    assert code == 0, err
    assert f"on the LocalCluster of {tmp_path / name}" in err
    assert "distributed" not in err
    xr.testing.assert_identical(xr.open_zarr(tmp_path / "s.zarr").load().drop_attrs(), reference)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([name, "s.zarr", "small.toml"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "class = missing: must be the import path"),
        ("class = 1\nscale = 1\n", "class = 1: must be the import path"),
        ('class = "LocalCluster"\nscale = 1\n', "class = 'LocalCluster': must be the import path"),
        ('class = "no_such_package.Cluster"\nscale = 1\n', "No module named 'no_such_package'"),
        ('class = "distributed.NoCluster"\nscale = 1\n', "has no attribute 'NoCluster'"),
        ('class = "distributed.Client"\nscale = 1\n', "is no class of a Dask cluster"),
        ('class = "os.path.join"\nscale = 1\n', "is no class of a Dask cluster"),
        (LOCAL, "write either scale = WORKERS or adapt"),
        (LOCAL + "scale = 1\nadapt = { maximum = 2 }\n", "write either scale = WORKERS or adapt"),
        (LOCAL + "scale = 0\n", "scale.n = 0: input should be greater than or equal to 1"),
        (LOCAL + "scale = true\n", "scale = True: input should be"),
        (LOCAL + "scale = { jobs = -1 }\n", "scale.jobs = -1: input should be greater"),
        (LOCAL + "scale = { dwarfs = 7 }\n", "unexpected keyword argument 'dwarfs'"),
        (LOCAL + "adapt = { minimum = 1 }\n", "adapt: must say a maximum"),
        (LOCAL + "adapt = { maximum = 0 }\n", "adapt.maximum = 0: input should be greater than or equal to 1"),
        (LOCAL + "adapt = { minimum = 3, maximum = 2 }\n", "adapt: minimum = 3: must be at most maximum = 2"),
        (LOCAL + "adapt = { maximum = 2, pace = 3 }\n", "unknown key adapt.pace; known are interval,"),
        (LOCAL + "scale = 1\noptions = 3\n", "options = 3: input should be a valid dictionary"),
        (LOCAL + "scale = 1\nscales = 1\n", "unknown key scales; did you mean 'scale'?"),
        (LOCAL + "scale = 1\n[options]\nn_wrokers = 1\n", "unexpected keyword argument 'n_wrokers'"),
        slow(LOCAL + 'scale = 1\n[options]\nhost = "1.2.3.4"\n', "distributed.LocalCluster: "),
        ("scale = = 1\n", "not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_told_and_nothing_written(link_study, tmp_path, sweep_here, text, says):
    path = tmp_path / "cluster.toml"
    path.write_text(text)
    code, _, err = sweep_here("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", path, cwd=tmp_path)
    assert code == 2, err
    assert err.startswith(f"error: {path}: "), err
    assert says in err
    assert "Traceback" not in err
    assert "distributed." not in err.replace("distributed.LocalCluster", "").replace("'distributed.", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cluster.toml", "small.toml"]


def test_yaml_that_is_none_is_told(link_study, tmp_path, sweep_here):
    (tmp_path / "cluster.yaml").write_text("class: [\n")
    code, _, err = sweep_here("run", link_study, "--cluster", tmp_path / "cluster.yaml")
    assert code == 2
    assert "not valid YAML" in err


@pytest.mark.parametrize(
    "options",
    [
        ("--scheduler", "tcp://127.0.0.1:1", "--cluster"),
        ("--workers", "2", "--cluster"),
        ("--memory-limit", "2GB", "--cluster"),
        ("--tls-ca",),
        ("--memory-limit", "much", "--pool", "serial", "--cluster"),
        ("--time-limit", "0", "--cluster"),
    ],
)
def test_contradictions_are_refused(link_study, tmp_path, sweep_here, options):
    (tmp_path / "cluster.toml").write_text(LOCAL + "scale = 1\n")
    code, _, err = sweep_here("run", link_study, "-o", tmp_path / "s.zarr", *options, tmp_path / "cluster.toml")
    assert code == 2
    assert "Error: " in err
    assert not (tmp_path / "s.zarr").exists()
