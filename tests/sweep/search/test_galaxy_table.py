"""The 46-byte table: its bytes, both ways, and every bad line."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.sweep.contract import SweepError
from linksweep.sweep.search.galaxy_table import GalaxyTable, format_galaxy_table, read_galaxy_table


def test_the_byte_positions_of_the_table():
    table = GalaxyTable(
        tyc=np.array([[1, 13, 1], [9537, 12121, 3]]),
        pgc=np.array([7, 65866]),
        ra=np.array([0.5, 359.999999999]),
        dec=np.array([-89.12345678, 4.25]),
        code=np.array([0, 2]),
    )
    text = format_galaxy_table(table)
    #                   1234567890123456789012345678901234567890123456
    assert text == ("   1    13 1     7   0.50000000 -89.12345678 G\n9537 12121 3 65866   0.00000000   4.25000000 S\n")
    line = text.splitlines()[1]
    assert (line[0:4], line[5:10], line[11:12], line[13:18]) == ("9537", "12121", "3", "65866")
    assert (line[19:31], line[32:44], line[45:46], len(line)) == ("  0.00000000", "  4.25000000", "S", 46)


numbers = st.tuples(
    st.integers(1, 9537),
    st.integers(1, 12121),
    st.integers(1, 3),
    st.integers(1, 99999),
    st.integers(0, 36_000_000_000 - 1),
    st.integers(-9_000_000_000, 9_000_000_000),
    st.integers(0, 2),
)


@settings(derandomize=True)
@given(st.lists(numbers, max_size=20))
def test_the_table_is_read_back_as_it_was_written(tmp_path_factory, rows):
    columns = np.array(rows, dtype=np.int64).reshape(-1, 7)
    table = GalaxyTable(columns[:, :3], columns[:, 3], columns[:, 4] / 1e8, columns[:, 5] / 1e8, columns[:, 6])
    path = tmp_path_factory.mktemp("t") / "t.dat"
    path.write_text(format_galaxy_table(table))
    back = read_galaxy_table(path)
    for name in ("tyc", "pgc", "ra", "dec", "code"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))


GOOD = "9537 12121 3 65866   0.00000000   4.25000000 S"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (GOOD + " ", "line 2 has 47 bytes, not 46"),
        (GOOD[:-1], "line 2 has 45 bytes, not 46"),
        ("", "line 2 has 0 bytes, not 46"),
        ("9537x12121 3 65866   0.00000000   4.25000000 S", "line 2: byte 5 is 'x', not a blank"),
        (
            "9537 12121 3 65866   0.00000000   4.25000000 X",
            "line 2: class (bytes 46-46) is 'X', must be one of G, U, S",
        ),
        ("9537 12121 3 65866   0.00000000   4.25000000  ", "line 2: class (bytes 46-46) is ' '"),
        ("   a 12121 3 65866   0.00000000   4.25000000 S", "TYC1 (bytes 1-4) is '   a', must be an integer 1..9999"),
        ("   0 12121 3 65866   0.00000000   4.25000000 S", "TYC1 (bytes 1-4) is '   0'"),
        ("9537 12121 3       " + GOOD[19:], "PGC (bytes 14-18) is '     ', must be an integer 1..99999"),
        (
            "9537 12121 3 65866 360.00000001   4.25000000 S",
            "RAdeg (bytes 20-31) is '360.00000001', must be a number 0..360",
        ),
        (
            "9537 12121 3 65866   0.00000000 -90.00000001 S",
            "DEdeg (bytes 33-44) is '-90.00000001', must be a number -90..90",
        ),
        ("9537 12121 3 65866          nan   4.25000000 S", "RAdeg (bytes 20-31)"),
        ("9537 12121 3 65866   0.0000 000   4.25000000 S", "RAdeg (bytes 20-31)"),
    ],
)
def test_a_bad_line_of_the_table_is_named(tmp_path, line, message):
    path = tmp_path / "t.dat"
    path.write_text(f"{GOOD}\n{line}\n{GOOD}\n")
    with pytest.raises(SweepError, match=re.escape(message)) as error:
        read_galaxy_table(path)
    assert error.value.where == str(path)


def test_a_table_that_is_no_text_or_not_there(tmp_path):
    (tmp_path / "b.dat").write_bytes(b"\xff\xfe" * 30)
    with pytest.raises(SweepError, match="byte 0 is not ASCII"):
        read_galaxy_table(tmp_path / "b.dat")
    with pytest.raises(SweepError, match="No such file"):
        read_galaxy_table(tmp_path / "c.dat")


def test_windows_line_ends_are_read(tmp_path):
    (tmp_path / "t.dat").write_bytes(f"{GOOD}\r\n{GOOD}\r\n".encode())
    assert len(read_galaxy_table(tmp_path / "t.dat")) == 2


def test_a_galaxy_without_pgc_number_or_with_a_long_one_does_not_fit():
    table = GalaxyTable(
        np.array([[1, 13, 1], [1, 14, 1]]), np.array([0, 100_000]), np.zeros(2), np.zeros(2), np.zeros(2, dtype=int)
    )
    with pytest.raises(SweepError) as error:
        format_galaxy_table(table)
    assert error.value.problems == [
        "TYC 1-13-1 has no PGC number",
        "TYC 1-14-1: PGC = 100000 does not fit bytes 14-18, at most 99999",
    ]
