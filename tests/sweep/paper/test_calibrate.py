"""`sweep calibrate`, as a user types it."""

import io
import json

import pytest

from linksweep.sweep.paper.calibrate import as_text, calibration_report


@pytest.fixture(scope="module")
def report():
    """A report from a few catalogues only."""
    return calibration_report(n_cat=20)


@pytest.mark.slow
def test_the_command_prints_json(sweep):
    code, out, err = sweep("calibrate", "--json")
    assert code == 0, err
    curves = json.loads(out)["curves"]
    assert list(curves) == ["amex", "gaia"]
    for curve, count in zip(curves.values(), (28, 13), strict=True):
        assert len(curve["numbers"]) == count
        assert curve["in_code_distance2"] < 1.5 * len(curve["constants"])
        for name, constant in curve["constants"].items():
            assert abs(constant["fitted"] - constant["in_code"]) < 1.5 * constant["standard_error"]
            assert constant["in_code"] == pytest.approx(curve["chosen"][name], rel=0.01)


@pytest.mark.slow
def test_equal_weights_fit_the_quasars_and_miss_the_radio_stars(report):
    """What the document says of the rejected hypothesis; few catalogues change a residual by some per cent."""
    equal = report["curves"]["amex"]["equal_weights"]
    residuals = {
        kind: [r["residual"] for r in equal["numbers"] if r["kind"] == kind] for kind in ("quasars", "radio-stars")
    }
    assert max(map(abs, residuals["quasars"])) < 0.03
    assert min(residuals["radio-stars"]) > 0.8
    assert "perfect_satellite" not in report["curves"]["gaia"]["equal_weights"]


@pytest.mark.slow
def test_the_independent_check_is_told(report):
    check = report["curves"]["amex"]["independent_check"]
    assert check["published"] == 0.25
    assert check["in_code"] == pytest.approx(0.1804, abs=0.0001)  # 0.139 + 14.2 exp(-5.838)


@pytest.mark.slow
def test_the_text_says_what_the_numbers_mean(report):
    from rich.console import Console

    console = Console(width=200, record=True, file=io.StringIO())
    console.print(as_text(report))
    text = console.export_text()
    assert "no curve saves this hypothesis" in text
    assert "[mas/yr]" in text
    assert "10 radio stars, VLBI errors x 0.5" in text
