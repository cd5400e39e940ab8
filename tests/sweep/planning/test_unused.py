"""A parameter that a study sets and that changes nothing is refused by name, above all as an axis."""

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.reader import study_from_dict

SHAPES = """
from linksweep.sweep.contract import Experiment, Output, Parameter

asked = []

def unused(p):
    asked.append(1)
    if p["shape"] == "square":
        return {"height": "a square has one side", "tilt": "a square is drawn upright"}
    return {}

experiment = Experiment(
    name="shapes", version=1,
    parameters=(
        Parameter("shape", "str", "square", "what is drawn", choices=("square", "box")),
        Parameter("width", "float", 1.0, "one side"),
        Parameter("height", "float", 1.0, "the other"),
        Parameter("tilt", "float", 0.0, "by how much it leans"),
        Parameter("ink", "int", 0, "colour"),
    ),
    sums={"area": ()}, outputs=(Output("area", "", "area", headline=True),),
    evaluate=lambda points, n, rng, outer: {"area": [n * p["width"] * p["height"] for p in points]},
    summarise=lambda sums, n, n_cat: {"area": sums["area"] / n},
    unused=unused,
)
"""


@pytest.fixture
def study(tmp_path):
    """A function that returns the study of some axes and fixed parameters."""
    (tmp_path / "shapes.py").write_text(SHAPES)

    def make(axes=None, fixed=None, **rest):
        reference = f"{tmp_path / 'shapes.py'}:experiment"
        return study_from_dict({"title": "", "experiment": reference, "axes": axes or {}, "fixed": fixed or {}, **rest})

    return make


def problems(study):
    with pytest.raises(SweepError) as error:
        make_grid(study)
    return error.value.problems


def test_a_fixed_parameter_must_matter_somewhere(study):
    assert problems(study(fixed={"height": 3.0})) == ["height = 3.0 changes nothing: a square has one side"]
    assert problems(study(fixed={"height": 1.0}))  # even at its default: who sets it thinks that it matters
    assert problems(study({"width": [1.0, 2.0]}, {"height": 3.0, "tilt": 1.0})) == [
        "height = 3.0 changes nothing: a square has one side",
        "tilt = 1.0 changes nothing: a square is drawn upright",
    ]
    make_grid(study())
    make_grid(study(fixed={"height": 3.0, "shape": "box"}))
    make_grid(study({"shape": ["square", "box"]}, {"height": 3.0}))  # it matters for one of the two


def test_an_axis_must_matter_wherever_it_is_not_at_its_default(study):
    (only,) = problems(study({"height": [1.0, 2.0, 3.0]}))
    assert only == "the axis height changes nothing at some points: a square has one side (2 points)"
    (only,) = problems(study({"shape": ["square", "box"], "height": [1.0, 2.0]}))
    assert only.endswith("(1 point)")
    make_grid(study({"shape": ["square", "box"], "height": [1.0, 2.0]}, exclude=[{"shape": "square", "height": 2.0}]))
    make_grid(study({"shape": ["square", "box"], "height": [1.0, 2.0]}, grid={"zip": [["shape", "height"]]}))


def test_a_large_grid_asks_as_often_as_the_answer_can_differ(study):
    large = study({"shape": ["box", "square"], "ink": {"start": 1, "stop": 20_000, "step": 1}})
    make_grid(large)
    assert len(large.experiment.unused.__globals__["asked"]) < 10


def test_what_cannot_be_understood_of_it_is_a_sentence(study):
    wrong = study()
    for answer, words in ((lambda p: {"hight": "x"}, "'hight'"), (lambda p: 1 / 0, "ZeroDivisionError")):
        object.__setattr__(wrong.experiment, "unused", answer)
        (only,) = problems(wrong)
        assert words in only


def test_the_command_refuses_it_and_writes_nothing(study, tmp_path, sweep):
    study()
    (tmp_path / "s.toml").write_text(
        'title = "s"\nexperiment = "shapes.py:experiment"\n[axes]\nheight = [1.0, 2.0]\n[sampling]\nn_sim = 2\n'
    )
    code, out, err = sweep("run", "s.toml", "-o", "s.zarr", cwd=tmp_path)
    assert (code, out) == (2, "")
    assert "the axis height changes nothing" in err
    assert not (tmp_path / "s.zarr").exists()
