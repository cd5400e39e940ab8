"""A parameter that a study sets and that changes nothing is refused by name, above all as an axis."""

import pytest

SHAPES = """
from linksweep.sweep.contract import Experiment, Output, Parameter

def unused(p):
    with open("asked", "a") as file:
        file.write("1")
    if p["shape"] == "square":
        return {"height": "a square has one side", "tilt": "a square is drawn upright"}
    return ANSWER

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
def plan(tmp_path, sweep):
    """A function that plans a study, and returns the exit code and the problems that are named."""

    def planned(study="", answer="{}", command="plan"):
        (tmp_path / "shapes.py").write_text(SHAPES.replace("ANSWER", answer))
        (tmp_path / "s.toml").write_text(f'title = "s"\nexperiment = "shapes.py:experiment"\n{study}')
        code, out, err = sweep(command, "s.toml", cwd=tmp_path)
        assert (code == 0) == bool(out)
        assert not (tmp_path / "results").exists()
        return code, err

    return planned


@pytest.mark.parametrize(
    ("study", "named"),
    [
        ("fixed = { height = 3.0 }", ["height = 3.0 changes nothing: a square has one side"]),
        ("fixed = { height = 1.0 }", ["height = 1.0 changes nothing"]),  # even at its default: it seems to matter
        ("axes = { width = [1, 2] }\nfixed = { height = 3.0, tilt = 1.0 }", ["height = 3.0", "tilt = 1.0"]),
        ("axes = { height = [1, 2, 3] }", ["the axis height changes nothing at some points: a square has one side (2"]),
        ('axes = { shape = ["square", "box"], height = [1, 2] }', ["the axis height changes nothing", "(1 point)"]),
    ],
)
def test_what_changes_nothing_is_refused_by_name_and_nothing_is_written(plan, study, named):
    for command in ("plan", "run"):
        code, said = plan(study, command=command)
        assert code == 2
        assert all(words in said for words in named)


@pytest.mark.parametrize(
    "study",
    [
        "",
        'fixed = { height = 3.0, shape = "box" }',
        'axes = { shape = ["square", "box"] }\nfixed = { height = 3.0 }',  # it matters for one of the two
        'axes = { shape = ["square", "box"], height = [1, 2] }\nexclude = [{ shape = "square", height = 2 }]',
        'axes = { shape = ["square", "box"], height = [1, 2] }\ngrid = { zip = [["shape", "height"]] }',
    ],
)
def test_what_matters_at_some_point_is_taken(plan, study):
    assert plan(study)[0] == 0


def test_a_large_grid_asks_as_often_as_the_answer_can_differ(plan, tmp_path):
    assert plan('axes = { shape = ["box", "square"], ink = { start = 1, stop = 2000, step = 1 } }')[0] == 0
    assert len((tmp_path / "asked").read_text()) < 10


@pytest.mark.parametrize(("answer", "words"), [('{"hight": "x"}', "'hight'"), ("1 / 0", "ZeroDivisionError")])
def test_what_cannot_be_understood_of_it_is_a_sentence(plan, answer, words):
    code, said = plan('fixed = { shape = "box" }', answer)
    assert code == 2
    assert words in said
