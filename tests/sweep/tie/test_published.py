"""Published links from the built-in tables."""

import numpy as np
import xarray as xr
from click.testing import CliRunner

import linksweep
from linksweep import tie
from tests.core.tie.made import main


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
    """A write that failed half-way left a folder by that name, which the next run refused."""
    command, write = ["tie", "psrpi-de200", "timing-de200", "-o", str(tmp_path / "link.zarr")], xr.Dataset.to_zarr

    def interrupted(dataset, *arguments, **options):
        write(dataset[["estimate"]], *arguments, **options)
        raise OSError("no space left on device")

    monkeypatch.setattr(xr.Dataset, "to_zarr", interrupted)
    assert CliRunner().invoke(main, command).exit_code != 0
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())
    assert CliRunner().invoke(main, command).exit_code == 0
    assert linksweep.open(tmp_path / "link.zarr").estimate.shape == (6,)
    assert CliRunner().invoke(main, command).exit_code == 2
