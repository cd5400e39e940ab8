"""What is recorded of the command line: the options of `sweep` without secrets, and nothing of a user's own script."""

import re
import runpy
import sys

import pytest
from hypothesis import given, settings, strategies as st

from linksweep.sweep.formatting import without_secrets
from tests.tiers import examples, slow

SECRET = "hunter2"

SCRIPT = """
import linksweep

def double(x: float = 1.0):
    return 2.0 * x

if __name__ == "__main__":
    linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", pool="serial")
"""


def everything_in(folder):
    return b"".join(file.read_bytes() for file in folder.rglob("*") if file.is_file() and file.suffix != ".py")


@pytest.mark.parametrize("name", ["script.py", slow("sweep"), slow("sweep.py")])
def test_nothing_of_a_scripts_own_options(tmp_path, name, monkeypatch):
    (tmp_path / name).write_text(SCRIPT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, "--password", SECRET, f"--token={SECRET}"])
    monkeypatch.setattr(sys, "orig_argv", [sys.executable, *sys.argv])
    runpy.run_path(name, run_name="__main__")
    (tmp_path / name).unlink()
    assert SECRET.encode() not in everything_in(tmp_path)


def test_the_options_of_sweep_without_secrets(tmp_path, sweep_here):
    (tmp_path / "double.py").write_text(SCRIPT)
    options = ("--axis", "x=1,2", "--log", "x.log", "-o", "s.zarr")
    scheduler = f"tcp://me:{SECRET}@127.0.0.1:1/?token={SECRET}"
    code, _, err = sweep_here("run", "double.py:double", *options, "--scheduler", scheduler, cwd=tmp_path)
    assert code == 2, err
    code, _, err = sweep_here("run", "double.py:double", *options, "--pool", "serial", cwd=tmp_path)
    assert code == 0, err
    kept = everything_in(tmp_path)
    assert b"sweep run double.py:double --axis x=1,2 --log x.log" in kept
    assert SECRET.encode() not in kept


@settings(max_examples=examples(50))
@given(
    scheme=st.sampled_from(["tcp", "tls", "https", "s3", "WSS"]),
    user=st.sampled_from(["", f"me:{SECRET}@", f"{SECRET}@", f"me:{SECRET}/x@", f"me:@{SECRET}:@"]),
    host=st.sampled_from(["host", "a.b-c:1234", "x"]),
    rest=st.sampled_from(["", f"/?token={SECRET}", f"?X-Amz-Signature={SECRET}&x=1", f"/#{SECRET}", "/a/b"]),
    around=st.sampled_from(["{}", "--scheduler={}", "run -o '{}' x", '"{}"']),
)
def test_addresses_have_no_secrets(scheme, user, host, rest, around):
    said = without_secrets(around.format(f"{scheme}://{user}{host}{rest}"))
    assert SECRET not in said
    assert re.search(re.escape(f"{scheme}://{host}"), said)
