"""Stores by the names of their studies."""

from sweep.stores.named import short_name, store_named


def test_the_name_of_a_study_is_that_of_its_store(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(store_named("quasars")) == "quasars"
    (tmp_path / "results" / "quasars.zarr").mkdir(parents=True)
    assert str(store_named("quasars")) == str(store_named("results/quasars.zarr")) == "results/quasars.zarr"
    assert short_name(store_named("quasars")) == "quasars"
    assert short_name(store_named("elsewhere/quasars.zarr")) == "elsewhere/quasars.zarr"


def test_a_path_that_exists_goes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("results/quasars.zarr", "quasars"):
        (tmp_path / folder).mkdir(parents=True)
    assert str(store_named("quasars")) == "quasars"
    assert short_name(store_named("results/quasars.zarr")) == "results/quasars.zarr"
