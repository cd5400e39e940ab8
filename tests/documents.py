"""What the documents show: code and commands."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parent.parent


def code(document, language):
    text = (ROOT / "docs" / document).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def commands(document):
    lines = [line for block in code(document, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("sweep ")]


def run_commands(document, sweep, folder):
    """Run the commands that a document shows, one after the other, in a folder."""
    for command in commands(document):
        status, _, err = sweep(*shlex.split(command, comments=True)[1:], cwd=folder)
        assert status == 0, f"{command}: {err}"
