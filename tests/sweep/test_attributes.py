"""What xarray makes of the attributes of results: labels that are short, and brackets only around units."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import linksweep
from linksweep.sweep.formatting import described, meaning_of, short_meaning
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.document import built_in_studies
from linksweep.sweep.studies.reader import load_study
from tests.tiers import slow

LONGEST_LABEL = 90
"""Characters, three lines of xarray's labels."""


@given(st.text(max_size=60))
def test_the_whole_meaning_is_kept(meaning):
    attributes = described("", meaning)
    assert meaning_of(attributes) == meaning
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


def test_the_plots_of_xarray_are_labelled(store_of):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    dataset = open_dataset(store_of("quasars"))
    figure, axes = pyplot.subplots()
    dataset["sigma_spin"].sel(model="gaia").plot.line(ax=axes)
    assert axes.get_ylabel().split() == ["RMS", "error", "of", "the", "spin", "[mas", "/", "yr]"]
    assert axes.get_xlabel() == "limiting magnitude V [mag]"
    axes.clear()
    dataset["n_obj"].sel(model="gaia").plot.line(ax=axes)
    assert axes.get_ylabel().replace("\n", " ") == "number of objects in the catalogue"
    pyplot.close(figure)


def test_xarray_draws_over_coordinates_of_text(store_of):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    dataset = linksweep.open(store_of("quasars"))
    assert dataset["model"].values.tolist() == ["amex", "gaia"]
    figure, axes = pyplot.subplots()
    dataset["sigma_spin"].plot(ax=axes)
    assert axes.get_xlabel() == "limiting magnitude V [mag]"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["amex", "gaia"]
    pyplot.close(figure)


@pytest.mark.parametrize("name", sorted(built_in_studies()))
def test_labels_of_the_built_in_experiments_are_short(name):
    experiment = load_study(name).experiment
    for declared in (*experiment.outputs, *experiment.sample_outputs, *experiment.parameters):
        assert 0 < len(short_meaning(declared.meaning)) <= LONGEST_LABEL, declared.name
