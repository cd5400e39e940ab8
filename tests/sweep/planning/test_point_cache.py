"""A slow question is asked once for each combination of what it looks at."""

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.planning.point_cache import PointCache
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


def test_a_question_that_copies_its_point_looks_at_everything():
    answers = PointCache(lambda point: sum({**point, "fixed": 0}.values()), ["a", "b"])
    assert [answers({"a": a, "b": b, "fixed": 9}) for a in (1, 2) for b in (10, 20)] == [11, 21, 12, 22]


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
