"""The title of a function's results is the first line of its docstring."""

import pytest

import linksweep


def cooling(start: float):
    """A cup of coffee that cools.

    The room has 20 degrees.
    """
    return start


def priced(start: float):
    """What $x costs."""
    return start


def bare(start: float):
    return start


@pytest.mark.parametrize(
    ("function", "title", "shown"),
    [
        (cooling, None, "A cup of coffee that cools"),
        (cooling, "Coffee", "Coffee"),
        (priced, None, "priced"),
        (bare, None, "bare"),
    ],
)
def test_the_title_is_the_first_line_of_the_docstring(tmp_path, function, title, shown):
    axes = {"start": [30.0, 50.0]}
    dataset = linksweep.run(function, tmp_path / "s.zarr", axes=axes, title=title, pool="serial")
    assert dataset.attrs["title"] == shown
    assert linksweep.open(tmp_path / "s.zarr").attrs["title"] == shown


def slope(x: float, kind: str):
    return {"rise": x if kind == "up" else -x, "level": 3.0 + x, "same": 0.0}


def test_each_output_says_what_decides_it(tmp_path):
    from linksweep.sweep.analysis.answer import answers

    dataset = linksweep.run(slope, tmp_path / "s.zarr", axes={"x": [1.0, 3.0], "kind": ["up", "down"]}, pool="serial")
    said = {answer.name: answer.sentences[1:] for answer in answers(dataset)}
    assert said["rise"] == ["What changes it: kind by up to 6, x by up to 2, all else being equal."]
    assert said["level"] == ["What changes it: x by a factor of up to 1.50, all else being equal."]
    assert not said.get("same")
