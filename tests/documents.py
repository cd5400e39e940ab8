"""What the documents show: code and commands."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parent.parent


def code(document, language):
    return re.findall(rf"```{language}[^\n]*\n(.*?)```", (ROOT / "docs" / document).read_text(), flags=re.DOTALL)


def save_files(document, folder):
    """Write the blocks that have the name of a file; return the text of the document."""
    text = (ROOT / "docs" / document).read_text()
    for name, content in re.findall(r"^```\w+ (\S+)\n(.*?)^```", text, re.M | re.S):
        (folder / name).write_text(content)
    return text


def commands(document):
    blocks = code(document, r"(?:sh|\{picture\})")
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("sweep ")]


def run_commands(document, sweep, folder):
    for command in commands(document):
        words = shlex.split(command, comments=True)[1:]
        words, file = (words[:-2], words[-1]) if ">" in words else (words, None)
        out = sweep(*words, cwd=folder, code=0)[1]
        if file:
            (folder / file).write_text(out)
