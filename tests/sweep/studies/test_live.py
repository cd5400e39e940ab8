"""Python objects as axes: those whose order or values are not fixed are put in order or refused."""

import os
import subprocess
import sys

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.studies.reader import study_of_function


def law(a: float = 1.0, m: str = "x", e=1):
    return a


def test_texts_of_a_set_are_in_the_same_order_in_every_process():
    code = (
        "from linksweep.sweep.studies.reader import study_of_function as study; "
        "from tests.sweep.studies.test_live import law; "
        "print(study(law, {'m': {'tin', 'gold', 'lead', 'iron'}}).axes['m'])"
    )
    for seed in "12":
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONHASHSEED": seed},
        )
        assert done.stdout.strip() == "('gold', 'iron', 'lead', 'tin')"


def test_a_set_without_an_order_is_refused():
    with pytest.raises(SweepError, match=r"axes.e: is a set of int, str, which have no order; give a list"):
        study_of_function(law, {"e": {1, "a"}})


@pytest.mark.parametrize("axis", [(x for x in (1.0, 2.0)), map(float, (1, 2)), iter([1.0, 2.0])])
def test_what_gives_its_values_once_is_refused(axis):
    with pytest.raises(
        SweepError, match=r"axes.a: is a .*, which gives its values only once; give a list, list\(...\), of them"
    ):
        study_of_function(law, {"a": axis})


def test_keys_and_values_of_a_mapping_are_axes():
    named = {1.0: "u", 2.0: "v"}
    study = study_of_function(law, {"a": named.keys(), "m": named.values()})
    assert dict(study.axes) == {"a": (1.0, 2.0), "m": ("u", "v")}
