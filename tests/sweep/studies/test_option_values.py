"""Values as options of the command line write them."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linksweep.sweep.contract import SweepError
from linksweep.sweep.studies.document import parse_axis, parse_places, parse_range


def test_places_are_listed_by_axis():
    assert parse_places(["model=gaia,v_max=16", "n=1"]) == {"model": "gaia", "v_max": "16", "n": "1"}
    with pytest.raises(SweepError, match="n is given twice, as 1 and 2"):
        parse_places(["n=1,n=2"])


@given(st.text(max_size=40))
def test_any_text_is_a_place_or_a_clear_error(text):
    with contextlib.suppress(SweepError):  # any other exception fails
        parse_places([text])


@pytest.mark.parametrize("parse", [parse_axis, parse_range])
@pytest.mark.parametrize("text", ['a,"c,d"', "'c,d',a", '"'])
def test_a_comma_in_quotes_does_not_cut_a_text(parse, text):
    with pytest.raises(SweepError, match="commas divide values"):
        parse(text)


def test_an_axis_of_texts_may_be_quoted_or_a_list():
    assert parse_axis("a,'c',\"d\"") == ["a", "c", "d"]
    assert parse_axis('["a", "c,d"]') == ["a", "c,d"]
