"""Values of an axis that a range writes."""

import pytest

from linksweep.sweep.studies.values import axis_values


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({"start": 1234567890123, "stop": 1234567890143, "step": 10}, range(1234567890123, 1234567890144, 10)),
        ({"start": 2**62 + 1, "stop": 2**62 + 3, "step": 1}, range(2**62 + 1, 2**62 + 4)),
        ({"start": 2**62 + 9, "stop": 2**62 + 1, "step": -3}, range(2**62 + 9, 2**62 + 1, -3)),
        ({"start": 1234567890123, "stop": 1234567890143, "num": 3}, range(1234567890123, 1234567890144, 10)),
        ({"start": 7, "stop": 1234567890123, "num": 2, "spacing": "log"}, [7, 1234567890123]),
        ({"start": 1234567890123, "stop": 1234567890123, "num": 1}, [1234567890123]),
    ],
)
def test_a_range_of_integers_is_exact(spec, expected):
    assert axis_values(spec, whole=True) == list(expected)


def test_a_step_is_not_rounded_away():
    """Twelve digits of a Julian date are 0.9 s, and made equal steps of 2.5e-5 days unequal without a word."""
    dates = axis_values({"start": 2460000.5, "stop": 2460000.5001, "step": 2.5e-5})
    assert dates == [2460000.5, 2460000.500025, 2460000.50005, 2460000.500075, 2460000.5001]
    assert axis_values({"start": 2460000.5, "stop": 2460000.5001, "num": 5}) == dates
    assert axis_values({"start": 0, "stop": 1, "num": 4})[1] == 0.333333333333  # stored: it must never change
