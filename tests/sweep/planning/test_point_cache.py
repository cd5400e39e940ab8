"""A slow question is asked once for each combination of what it looks at."""

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.sweep.planning.grid import PointCache
from tests.tiers import examples


def test_only_what_is_looked_at_makes_a_difference():
    asked = []

    def question(point):
        asked.append(1)
        return point["a"] * (point["b"] if point["a"] > 2 else 1)

    answers = PointCache(question, ["a", "b", "c"])
    for a, b, c in itertools.product(range(5), range(4), range(50)):
        assert answers({"a": a, "b": b, "c": c, "fixed": 1}) == a * (b if a > 2 else 1)
    assert len(asked) <= 5 * 4 + 4  # and a few before it was known that b matters


@settings(max_examples=examples(200), derandomize=True)
@given(st.lists(st.tuples(*[st.integers(0, 2)] * 4), min_size=1, max_size=60), st.integers(0, 2), st.integers(0, 2))
def test_the_answers_are_those_of_the_function_in_any_order(points, first, second):
    def question(point):
        names = "wxyz"
        here = point[names[first]]
        return (here, point[names[here]] if here != second else None)

    answers = PointCache(question, "wxyz")
    for values in points:
        point = dict(zip("wxyz", values, strict=True))
        assert answers(point) == question(point)


def test_the_table_has_the_answers_by_all_axes_that_were_looked_at():
    """Answers from before an axis was looked at lack its value."""

    def question(point):
        return point["a"] * (point["b"] if point["a"] > 1 else 1)

    answers = PointCache(question, ["a", "b", "c"])
    for a, b, c in itertools.product(range(4), range(3), range(2)):
        answers({"a": a, "b": b, "c": c, "fixed": 1})
    read, known = answers.table()
    assert set(read) == {"a", "b"}
    for key, answer in known.items():
        point = dict(zip(read, key, strict=True))
        assert answer == question(point)
    assert {dict(zip(read, key, strict=True))["a"] for key in known} >= {2, 3}
    assert not answers.is_constant


def test_what_reads_every_axis_has_no_table_and_is_asked_each_time():
    asked = []
    answers = PointCache(lambda point: asked.append(1) or point["a"] + point["b"], ["a", "b"])
    for a, b in itertools.product(range(3), range(3)):
        assert answers({"a": a, "b": b}) == a + b
    assert answers.table() is None
    assert len(asked) == 9
    assert answers({"a": 0, "b": 0}) == 0
    assert len(asked) == 10  # no memory is spent on what cannot be used twice
