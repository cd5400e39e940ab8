"""Two tiers of tests: quick ones that run by default, and those marked slow, with ``--all``."""

from typing import Any

import pytest
from hypothesis import settings

ALL, QUICK = "all tests", "quick tests"  # profiles of hypothesis, by tier
PATIENCE_S = 1200.0  # how long tests wait, on any machine, for what is to happen; less than pytest-timeout gives a test


def slow(*values: Any) -> Any:
    """Return values of a parametrised test that are only tried with ``--all``."""
    return pytest.param(*values, marks=pytest.mark.slow)


def few(number: int, values: Any) -> list[Any]:
    """Return values of a parametrised test of which only the first ones are tried without ``--all``."""
    return [slow(*(v if isinstance(v, tuple) else (v,))) if k >= number else v for k, v in enumerate(values)]


def examples(number: int, quick: int | None = None) -> int:
    """Return how many examples a property test has that has this number of them with ``--all``."""
    return number if settings.get_current_profile_name() == ALL else quick or max(number // 5, 5)
