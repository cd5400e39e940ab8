"""What the documents show: code and commands."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def code(document, language):
    text = (ROOT / "docs" / document).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def commands(document):
    lines = [line for block in code(document, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("sweep ")]
