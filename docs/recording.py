"""Records commands in a terminal as an animated picture for the README:

    python docs/recording.py docs/recording.svg

Each command is a real one that runs in a terminal of its own; Ctrl-C is a real interruption.  What the terminal shows
is taken as it is, at the times at which it was shown, but long waits are cut short.
"""

import os
import pty
import re
import select
import struct
import sys
import tempfile
import termios
import time
from collections.abc import Iterator
from fcntl import ioctl
from html import escape
from pathlib import Path

import pyte

COLUMNS, LINES = 80, 24
LETTER, LINE = 8.4, 18  # pixels of a letter's width, and from one line to the next
EVERY_S = 0.5  # between two frames at least
LONGEST_S, READ_S = 0.5, 6.0  # a frame is shown so long at most, the last one of a command so long
TYPED_S = 0.9

# The command, and what is shown when Ctrl-C is pressed.
COMMANDS = [("sweep run quasars", r"[3-9]\d % of the work"), ("sweep run quasars", None)]

COLOURS = {"red": "#ff7b72", "green": "#7ee787", "brown": "#e3b341", "blue": "#79c0ff", "magenta": "#d2a8ff"}
COLOURS |= {"cyan": "#56d4dd", "default": "#e6edf3", "black": "#6e7681", "white": "#ffffff"}

Frame = tuple[float, list[str]]


def frames_of(command: str, pressed_at: str | None, screen: pyte.Screen) -> Iterator[Frame]:
    """Run a command in a terminal; yield the seconds since its start and the drawn lines, whenever they change."""
    stream = pyte.ByteStream(screen)
    stream.feed(f"$ {command}\r\n".encode())
    begun = time.monotonic()
    yield 0.0, drawn(screen)
    process, terminal = pty.fork()
    if process == 0:
        os.execvpe("sh", ["sh", "-c", f"exec {command}"], {**os.environ, "TERM": "xterm-256color"})
    ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
    shown = 0.0
    while True:
        now = time.monotonic() - begun
        if pressed_at is not None and re.search(pressed_at, "".join(screen.display)):
            os.write(terminal, b"\x03")
            pressed_at = None
        ready, _, _ = select.select([terminal], [], [], EVERY_S / 5)
        try:
            content = os.read(terminal, 65536) if ready else None
        except OSError:  # Linux says so that the process has ended
            content = b""
        if content == b"":
            break
        if content:
            stream.feed(content)
        if now - shown > EVERY_S:
            shown = now
            yield now, drawn(screen)
    os.waitpid(process, 0)
    os.close(terminal)
    yield time.monotonic() - begun, drawn(screen)


def drawn(screen: pyte.Screen) -> list[str]:
    """Return the lines of a screen as text elements, with the styles that differ from the usual one."""
    lines = []
    for number in range(LINES):
        row, parts, column = screen.buffer[number], [], 0
        while column < COLUMNS:
            first, char = column, row[column]
            while column < COLUMNS and row[column]._replace(data="") == char._replace(data=""):
                column += 1
            text = "".join(row[place].data for place in range(first, column))
            if text.strip():
                colour = char.fg if char.fg.startswith("#") else COLOURS.get(char.fg, f"#{char.fg}")
                style = f' fill="{colour}"' if char.fg != "default" else ""
                style += ' font-weight="bold"' if char.bold else ""
                lead = len(text) - len(text.lstrip())
                place = f'x="{12 + (first + lead) * LETTER:.1f}"'
                parts.append(f"<tspan {place}{style}>{escape(text.strip())}</tspan>")
        lines.append("".join(parts))
    return lines


def animated(frames: list[Frame]) -> str:
    """Return a picture that shows frames one after the other, each from its time on, and begins anew at the end."""
    whole = frames[-1][0] + READ_S
    texts: dict[str, str] = {}  # each line of text once, however many frames have it
    css, groups = [], []
    for number, (start, lines) in enumerate(frames):
        end = frames[number + 1][0] if number + 1 < len(frames) else whole
        used = []
        for row, line in enumerate(lines):
            if line:
                name = texts.setdefault(line, f"t{len(texts)}")
                used.append(f'<use href="#{name}" y="{40 + row * LINE}"/>')
        first, last = 100 * start / whole, 100 * end / whole
        css.append(
            f"@keyframes k{number}{{0%,{first:.3f}%{{visibility:hidden}}"
            f"{first + 0.001:.3f}%,{last:.3f}%{{visibility:visible}}{min(last + 0.001, 100):.3f}%,100%{{visibility:"
            f"{'visible' if last >= 100 else 'hidden'}}}}}"
            f"#f{number}{{animation:k{number} {whole:.2f}s steps(1) infinite}}"
        )
        groups.append(f'<g id="f{number}" visibility="hidden">{"".join(used)}</g>')
    definitions = "".join(f'<text id="{name}">{line}</text>' for line, name in texts.items())
    width, height = 24 + COLUMNS * LETTER, 40 + LINES * LINE
    words = "A terminal in which " + ", then ".join(command for command, _ in COMMANDS) + " is run"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height}" role="img" aria-label="{words}" '
        f'font-family="DejaVu Sans Mono, Menlo, Consolas, monospace" font-size="14" fill="{COLOURS["default"]}">'
        f"<style>text{{white-space:pre}}{''.join(css)}</style><defs>{definitions}</defs>"
        f'<rect width="100%" height="100%" rx="8" fill="#0d1117"/>'
        f'<g fill="#6e7681"><circle cx="18" cy="16" r="5"/><circle cx="36" cy="16" r="5"/>'
        f'<circle cx="54" cy="16" r="5"/></g>{"".join(groups)}</svg>\n'
    )


def main() -> None:
    """Record the commands into the file that is named."""
    target = Path(sys.argv[1]).resolve()
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    frames: list[Frame] = []
    at = 0.0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        screen = pyte.Screen(COLUMNS, LINES)
        for command, pressed_at in COMMANDS:
            before = -TYPED_S
            for moment, lines in frames_of(command, pressed_at, screen):
                if frames and lines == frames[-1][1]:
                    continue
                at += min(moment - before, LONGEST_S) if frames else 0.0
                before = moment
                frames.append((at, lines))
            at += 1.5
        os.chdir("/")
    target.write_text(animated(frames), encoding="utf-8")


if __name__ == "__main__":
    main()
