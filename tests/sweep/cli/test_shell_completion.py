"""Completion in a shell: a real bash with the script that click makes."""

import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent


def offered(folder, *words):
    """What bash offers for the last word, by the function that the script defines."""
    script = f"""
eval "$(_SWEEP_COMPLETE=bash_source sweep)"
compopt() {{ echo "option: $1 $2" >> options; }}
COMP_WORDS=({" ".join(f"'{word}'" for word in words)})
COMP_CWORD={len(words) - 1}
_sweep_completion sweep
printf '%s\\n' "${{COMPREPLY[@]}}"
cat options 2>/dev/null || true
"""
    here = {"PATH": f"{BIN}:/usr/bin:/bin"}
    done = subprocess.run(["bash", "-c", script], cwd=folder, capture_output=True, text=True, check=True, env=here)
    assert done.stderr == ""
    return done.stdout.split("\n")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "plan"])
def test_a_study_is_built_in_or_a_file(tmp_path, command):
    (tmp_path / "quick.toml").touch()
    assert [name for name in offered(tmp_path, "sweep", command, "qu") if name] == ["quasars", "quick.toml"]
    assert "option: -o default" in offered(tmp_path, "sweep", command, "folder/qu")  # bash looks for files itself


def test_commands_and_keys_of_the_study_that_is_named_before(tmp_path):
    assert {"v_max=", "model=", "n_sim="} <= set(offered(tmp_path, "sweep", "run", "quasars", "--set", ""))
    (tmp_path / "mine.toml").write_text("title = 'x'\n[axes]\nlength = [1]\nlimit = [2]\nwidth = [3]\n")
    assert [o for o in offered(tmp_path, "sweep", "plan", "mine.toml", "--axis", "l") if o] == ["length=", "limit="]


@pytest.mark.slow
@pytest.mark.parametrize("content", [None, b"[[axes]]", b"[", b"\xff", b"axes = 3"])
def test_a_bad_study_offers_what_every_study_has(tmp_path, content):
    if content is not None:
        (tmp_path / "bad.toml").write_bytes(content)
    assert "n_sim=" in offered(tmp_path, "sweep", "run", "bad.toml", "--set", "n")
