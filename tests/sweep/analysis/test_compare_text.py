"""The comparison for reading: narrow enough for a terminal, nothing cut, and coloured only where there are colours."""

from dataclasses import replace

import pytest

from linksweep.sweep.analysis.compare import VERDICTS, Measured, PublishedNumber, judged, table

LONG = {"mission": "hipparcos", "reference_error_scale": 0.25, "satellite_errors": "magnitude", "weighting": "equal"}


def compared(value=0.000601, published=0.0006, where=None, what="width", source="A paper, Table 1", **changes):
    ours = Measured({"model": "gaia", "v_max": 14.5} if where is None else where, value, 2e-6)
    return replace(judged("coins", what, what, "mas / yr", ours, PublishedNumber(published, 5e-6, source)), **changes)


def lines_of(comparisons, width=80):
    return table(comparisons).fitting(width)[0].text(width).splitlines()


def test_numbers_are_in_the_unit_that_reads_best_and_what_rows_share_is_above_them():
    lines = lines_of([compared(), compared(0.0007, where={"model": "gaia", "v_max": 15.0})])
    assert lines[2:4] == ["coins: width [uas/yr], model=gaia", "A paper, Table 1"]
    assert lines[4].split() == ["reproduced", "v_max=14.5", "0.6010", "±", "0.0020", "0.60", "+0.2", "%", "2.4", "%"]
    assert lines[5].split()[:3] == ["NOT", "reproduced", "v_max=15"]


@pytest.mark.parametrize("width", [80, 140])
def test_no_line_is_longer_than_asked_for_and_no_place_is_cut(width):
    text = "A claim about what a mission finds with so many objects, which is as long as some of the paper's are"
    found = [compared(where=LONG, what=text), compared(0.0007, where=LONG | {"weighting": "own"}, what=text)]
    found.append(compared(where=LONG, what=text, source="B", reason="a reason that goes on and on, as they do " * 3))
    lines = lines_of(found, width)
    assert max(map(len, lines)) <= width
    whole = " ".join(" ".join(lines).split())
    assert all(f"{name}={value}" in whole for name, value in LONG.items())
    assert ("allowance" in lines[0]) == (width == 140)


def test_counts_that_all_agree_take_one_row():
    counts = [
        judged("coins", "n", "n", "", Measured({"coins": n}, n), PublishedNumber(n, 0.0, "A paper"))
        for n in (3.0, 5.0, 9.0)
    ]
    rows = lines_of(counts)
    assert len([line for line in rows if line.startswith("reproduced")]) == 1
    assert "all 3" in " ".join(rows)
    counts[1] = judged("coins", "n", "n", "", Measured({"coins": 5.0}, 6.0), PublishedNumber(5.0, 0.5, "A paper"))
    assert len([line for line in lines_of(counts) if "coins=" in line]) == 3


def test_colours_are_for_terminals():
    written = [table([compared()]).text(80, styled=styled) for styled in (True, False)]
    assert f"{VERDICTS['reproduced']}reproduced" in written[0]
    assert "\x1b" not in written[1]
