"""Units are chosen as people write numbers, astropy says that the number is the same; xarray's labels are short."""

import numpy as np
import pytest
from astropy import units
from hypothesis import given
from hypothesis import strategies as st

import linksweep
from linksweep.sweep.formatting import (
    described,
    in_short,
    prefixed,
    short_meaning,
    with_unit,
)
from linksweep.sweep.stores.store import open_dataset
from tests.tiers import slow

LONGEST_LABEL = 90
"""Characters, three lines of xarray's labels."""


@given(st.text(max_size=60))
def test_the_whole_meaning_is_kept(meaning):
    attributes = described("", meaning)
    assert attributes.get("description", attributes.get("long_name", "")) == meaning
    assert meaning.startswith(short_meaning(meaning))
    assert all(attributes.values())


@pytest.mark.parametrize("name", ["quasars", *map(slow, ["aberration", "galaxies"])])
def test_results_have_no_empty_attributes_and_whole_labels(store_of, name):
    dataset = open_dataset(store_of(name))
    for variable in dataset.variables.values():
        assert variable.attrs.get("units") != ""
        assert variable.attrs["long_name"]
        assert len(variable.attrs["long_name"]) <= LONGEST_LABEL
    assert dataset["n_obj"].attrs.get("units") is None


def test_xarray_draws_over_coordinates_of_text(store_of):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    dataset = linksweep.open(store_of("quasars"))
    assert dataset["model"].values.tolist() == ["amex", "gaia"]
    figure, axes = pyplot.subplots()
    dataset["sigma_spin"].plot(ax=axes)
    assert axes.get_xlabel() == "limiting magnitude V [mag]"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["amex", "gaia"]
    pyplot.close(figure)


@pytest.mark.parametrize(
    ("values", "unit", "chosen"),
    [
        (0.0005411, "mas / yr", "uas / yr"),
        ([0.65, 0.00054, 0.0017], "mas / yr", "uas / yr"),
        ([0.65, 0.57], "mas / yr", "mas / yr"),
        (1e-4, "mas yr-1", "uas yr-1"),
        (3000.0, "mas", "arcsec"),
        (0.003, "arcsec", "mas"),
        (2e-4, "s", "us"),
        (5000.0, "ms", "s"),
        (5000.0, "m", "km"),
        (2e-5, "km", "mm"),
        (2e6, "pc", "Mpc"),
        (2e4, "Hz", "kHz"),
        (1e5, "yr", "kyr"),
        ([0.0, np.nan, 0.004], "mas", "uas"),
    ],
)
def test_a_prefix_that_reads_well(values, unit, chosen):
    found = prefixed(np.array(values), unit)
    assert found.unit == chosen
    assert units.Unit(unit).to(units.Unit(chosen)) == pytest.approx(found.factor, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "unit"),
    [(1e-6, unit) for unit in ("", "d", "deg", "mag", "users / d", "%", "mas2 / yr2", "mas, mas", "1 / s", "yr", "h")]
    + [(5000.0, "s"), (5000.0, "arcsec"), (np.nan, "mas"), (0.0, "mas"), (np.inf, "mas")],
)
def test_what_takes_no_prefix_stays(value, unit):
    assert prefixed(value, unit) == (unit, 1.0)


def test_numbers_in_sentences():
    assert with_unit(0.0005411, 0.0000038, "mas / yr") == "0.5411 ± 0.0038 uas/yr"
    assert with_unit(2.8e-9, 2.5e-11, "mas") == "0.000002800 ± 0.000000025 uas"
    assert with_unit(100.0) == "100"
    assert in_short(0.0005411, 0.0000038, "mas / yr") == "0.54 uas/yr"
    assert [
        in_short(*numbers) for numbers in [(15533.0,), (1.0594, 0.01), (656.2, 3.0), (-0.004, 0.3), (2.0, 0.001)]
    ] == [
        *("15,533", "1.06", "660", "0.0", "2.0"),
    ]
