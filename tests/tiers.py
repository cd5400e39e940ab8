"""Two tiers of tests: quick ones that run by default, and those marked slow, with ``--all``."""

from typing import Any

import pytest


def slow(*values: Any) -> Any:
    """Return values of a parametrised test that are only tried with ``--all``."""
    return pytest.param(*values, marks=pytest.mark.slow)
