"""Published links from the built-in tables."""

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import tie
from linksweep.sweep.result import Result


def test_icrf2_against_icrf3():
    link = tie("icrf3", "icrf2", degree=2, clip="rayleigh")
    uas = 1000.0 * link.estimate.values
    assert int(link.n_sources_matched) == 3410
    assert int(link.n_sources) == 3237
    np.testing.assert_array_equal(np.round(uas[:6]), [11, 14, -1, 22, 63, 89])
    np.testing.assert_array_equal(np.round(1000.0 * link.error.values[:6]), [4, 4, 3, 4, 4, 4])
    assert link.attrs["sign"] == "reference-satellite"
    assert list(link.attrs["notes"]) == ["of orientation and spin the tables determine only the orientation"]


def test_timing_on_de200_against_vlbi():
    link = tie("psrpi-de200", "timing-de200", "orientation")
    assert int(link.n_sources) == 9
    np.testing.assert_allclose(link.estimate, [-0.90, -13.04, -12.18], atol=0.035)
    np.testing.assert_allclose(link.error, [0.99, 1.21, 0.48], atol=0.015)


def test_a_link_is_written_in_one_step(tmp_path, monkeypatch):
    """An interrupted write left a folder by that name, which the next run refused."""
    link, write = linksweep.tie("psrpi-de200", "timing-de200", "orientation"), xr.Dataset.to_zarr

    def interrupted(dataset, *arguments, **options):
        write(dataset[["estimate"]], *arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_zarr", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Result(link).save(tmp_path / "link.zarr")
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())
    Result(link).save(tmp_path / "link.zarr")
    assert linksweep.open(tmp_path / "link.zarr").estimate.values.tolist() == link.estimate.values.tolist()
    with pytest.raises(linksweep.SweepError, match="exists already"):
        Result(link).save(tmp_path / "link.zarr")
