"""Draws the pictures of the site and puts them into its pages.

A page has the command that draws a picture, and in a comment what the picture shows:

    ```{picture}
    sweep plot results/first.zarr -o first.svg
    # The error of GAIA falls as 1/sqrt(N).
    ```

Pictures are results, so they are not in the repository: they are drawn when the site is built.  In the plain file the
block is the command with its comment, and so it is on GitHub, where a link to a missing file would be a broken image.
"""

import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

DOCS = Path(__file__).parent
FOLDER = DOCS / "_build" / "pictures"

STORES = """
sweep run demo.toml
sweep run first.toml
sweep run quasars --set n_cat=10
sweep run sqrt-n --set n_cat=10
sweep run grid --axis error_scale=0.5:2:0.5 --axis n_obj=20,80,300 --set v_max=16 --set n_cat=2
sweep run error-surface --axis reference_error_scale=0:4:1 --set n_cat=2
sweep run scatter
sweep run zonal-errors --set n_cat=5
sweep run radio-stars --set n_cat=30
sweep run pulsar-forecast --set n_sim=500
sweep run walk.toml
sweep run sir.py:sir --axis beta=0.2:0.5:0.1 --set n=500 -o sir.zarr
sweep run waiting.py:waiting --axis load=0.3,0.5,0.7 --set n_sim=1000 --set seed=1 -o waiting.zarr
sweep run lost.py:lost --axis half_life=1,2,5,10 --axis years=5,10 -o lost.zarr
sweep run window.py:window --axis beta=2:10:2 -o window.zarr
sweep run flow.py:flow --design sobol:128 --range rw=0.05:0.15 --range length=1120:1680 --range hu=990:1110 -o flow.zarr
sweep tie psrpi-de200 timing-de200 --unknowns orientation --errors jackknife,bootstrap -o pulsars.zarr
sweep tie icrf3 icrf2 --degree 2 --clip rayleigh -o icrf.zarr
sweep tie dr4-gaia dr4-vlbi --epochs dr4-epochs --star-model 1003=7 --star-model 1006=7 -o dr4.zarr
sweep forecast psrpi psrpi --unknowns orientation,spin --add 2026,2030 --error 0.1 --choose 5 --for spin -o plan.zarr
"""
"""The commands that compute what the pictures show: those of the pages, with fewer realisations of what takes long."""


class Picture(SphinxDirective):
    """A command, the picture that it draws (a link to the report that it writes), and a caption."""

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
            return [shown, nodes.paragraph("", "", nodes.reference("", "", *words, refuri=picture.name, internal=True))]
        image = nodes.image(uri=f"/{picture.relative_to(DOCS)}", alt=alternative_text(picture) or caption)
        return [shown, nodes.figure("", image, nodes.caption("", "", *words))]


def drawn(command: str) -> str:
    """Return the name of the file that a command writes."""
    return next(word for word in shlex.split(command) if word.endswith((".svg", ".html")))


def alternative_text(picture: Path) -> str:
    """Return what `sweep plot --caption` says to who cannot see a picture, nothing for other commands."""
    text = picture.with_suffix(".txt")
    return text.read_text(encoding="utf-8").partition("Alternative text: ")[2].strip() if text.exists() else ""


def draw() -> None:
    """Compute the stores and draw the pictures of all pages, in the working directory."""
    pages = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md")))
    for name, text in re.findall(r"^```\w+ (\S+)\n(.*?)^```", pages, flags=re.MULTILINE | re.DOTALL):
        Path(name).write_text(text, encoding="utf-8")
    if not Path("stars.fits").exists():
        sys.path.insert(0, str(DOCS.parent))
        from benchmarks.crossmatch import make

        make(np.random.default_rng(1), 0.01, Path())
    blocks = [STORES, *re.findall(r"^```\{picture\}\n(.*?)^```", pages, flags=re.MULTILINE | re.DOTALL)]
    for command in re.findall(r"^sweep (.+)", "\n".join(blocks).replace("\\\n", " "), flags=re.MULTILINE):
        run(shlex.split(command))


def run(words: list[str]) -> None:
    """Run a command in this process, which has imported everything already."""
    from linksweep.sweep.cli import main

    caption = ["--caption"] if words[0] == "plot" else []
    if words[0] in ("tie", "forecast"):  # these write no store that exists
        shutil.rmtree(words[words.index("-o") + 1], ignore_errors=True)
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


def copy_reports(app: Sphinx, _error: Exception | None) -> None:
    """Put the reports next to the pages."""
    for report in FOLDER.glob("*.html"):
        shutil.copy(report, app.outdir)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("picture", Picture)
    app.connect("builder-inited", draw_before_reading)
    app.connect("build-finished", copy_reports)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    draw()
