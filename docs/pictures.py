"""Draws the pictures of the site and puts them into its pages.

A page has the command that draws a picture, and in a comment what the picture shows:

    ```{picture}
    sweep plot results/first.zarr -o first.svg
    # The error of GAIA falls as 1/sqrt(N).
    ```

Pictures are results, so they are not in the repository: they are drawn when the site is built.  In the plain file, and on
GitHub, the block is the command with its comment; a link to a file that is not there would be a broken image.
"""

import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

DOCS = Path(__file__).parent
FOLDER = DOCS / "_build" / "pictures"

STORES = """
sweep run first.toml
"""
"""The commands that compute what pictures show.  Files are those that the pages show under a name (```toml first.toml)."""


class Picture(SphinxDirective):
    """A command, the picture that it draws, and its caption; the text for who cannot see it is that of ``--caption``."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        command = "\n".join(line for line in self.content if not line.startswith("#"))
        caption = " ".join(line.lstrip("# ") for line in self.content if line.startswith("#"))
        picture = FOLDER / drawn(command)
        if not picture.exists():
            raise self.error(f"no picture {picture.name}: `{command}` did not draw it")
        self.env.note_dependency(str(picture))
        shown = nodes.literal_block(command, command, language="sh")
        words, _ = self.state.inline_text(caption, self.lineno)
        if picture.suffix == ".html":
            return [shown, nodes.paragraph("", "", *words)]
        image = nodes.image(uri=f"/{picture.relative_to(DOCS)}", alt=alternative_text(picture) or caption)
        return [shown, nodes.figure("", image, nodes.caption("", "", *words))]


def drawn(command: str) -> str:
    """Return the name of the file that a command writes."""
    words = shlex.split(command)
    return next(words[i + 1] for i, word in enumerate(words) if word in ("-o", "--map"))


def alternative_text(picture: Path) -> str:
    """Return what `sweep plot --caption` says to who cannot see a picture, nothing for other commands."""
    text = picture.with_suffix(".txt")
    return text.read_text(encoding="utf-8").partition("Alternative text: ")[2].strip() if text.exists() else ""


def draw() -> None:
    """Compute the stores and draw the pictures of all pages, in the working directory."""
    pages = [page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))]
    for page in pages:
        for name, text in re.findall(r"^```\w+ (\S+)\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL):
            Path(name).write_text(text, encoding="utf-8")
    blocks = [STORES, *re.findall(r"^```\{picture\}\n(.*?)^```", "\n".join(pages), flags=re.MULTILINE | re.DOTALL)]
    for command in re.findall(r"^sweep (.+)", "\n".join(blocks), flags=re.MULTILINE):
        run(shlex.split(command))


def run(words: list[str]) -> None:
    """Run a command in this process, which has imported everything already."""
    from sweep.cli import main

    caption = ["--caption"] if words[0] == "plot" else []
    with redirect_stdout(sys.stderr):
        try:
            main([*words, *caption], prog_name="sweep", standalone_mode=False)
        except SystemExit as end:
            if end.code:
                raise RuntimeError(f"sweep {shlex.join(words)}: exit code {end.code}") from end


def draw_before_reading(_app: Sphinx) -> None:
    """Draw in a process of its own; stores of an earlier build are not computed again."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / "log.txt").open("w") as log:
        done = subprocess.run([sys.executable, __file__], cwd=FOLDER, stdout=log, stderr=log, check=False)
    if done.returncode:
        raise RuntimeError(f"the pictures cannot be drawn:\n{(FOLDER / 'log.txt').read_text()[-2000:]}")


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("picture", Picture)
    app.connect("builder-inited", draw_before_reading)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    draw()
