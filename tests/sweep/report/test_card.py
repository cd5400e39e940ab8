"""The card of results: what a script prints, and what a notebook shows."""

import re

import pytest
import xarray as xr

import linksweep
from linksweep import SweepError

QUESTION = "How well do quasars alone tie a mission's proper motions to the extragalactic frame?"


@pytest.fixture
def results(store_of):
    return linksweep.open(store_of("quasars"))


def test_a_card_is_printed_as_question_and_answer(results):
    card = linksweep.answer(results)
    lines = str(card).splitlines()
    assert lines[0] == QUESTION
    assert lines[1:] == card.sentences
    assert "quasars" in lines[-1]


def test_a_notebook_shows_question_answer_and_a_picture_with_its_words(results):
    page = linksweep.answer(results)._repr_html_()
    assert "<strong>How well do quasars alone tie a mission&#x27;s proper motions" in page
    assert 'src="data:image/png;base64,iVBOR' in page
    [words] = re.findall(r'alt="([^"]*)"', page)
    assert "limiting magnitude" in words.lower() or "V" in words


def test_whatever_a_study_says_is_text(results):
    page = linksweep.answer(results.assign_attrs(question="<script>alert(1)</script>"))._repr_html_()
    assert "<script>" not in page


def test_incomplete_results_say_so_first(results):
    status = results["status"].copy()
    status[{"v_max": 0}] = 0
    card = linksweep.answer(results.assign(status=status))
    assert card.sentences[0].startswith("Incomplete: ")


def test_a_dataset_of_something_else_is_refused():
    with pytest.raises(SweepError, match="no result of a study"):
        linksweep.answer(xr.Dataset({"x": 1.0}))
