"""Mutilated study files: what a slip of the hand, a bad editor or malice make of a good one."""

import random
import re
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent

NASTY = r"""
    0 -1 1 2 3.5 -0.0 1e308 -1e308 1e309 5e-324 nan inf -inf 1_000 0x10 0b1 9223372036854775808 9999999999999999999999
    true false "" "x" 'x' "\u0000" "\u202e\u2066abc" "\U0001F600" "e\u0301" "\n" "${HOME}" "../../etc/passwd"
    "/dev/zero" "amex" "gaia" "quasars" "synthetic" "linksweep.core.experiment:link" "math:tau" ":" "no.py:x"
    [] [[]] [1] [1,1]
    [1,2,3] ["a"] [true] [nan] {} {a=1} {start=1,stop=2,step=1} {start=1,stop=1e9,step=1}
    {start=0,stop=1,num=1000000000}
    {start=1,stop=0,step=-1e-12} {start=1,stop=2,num=3,spacing="log"} {start=-1,stop=2,num=3,spacing="log"}
    {values=[1]} {above=1} {in=[1]} 1979-05-27 07:32:00 1979-05-27T07:32:00Z [[[[[[[[[[1]]]]]]]]]] '''raw'''
""".split()  # noqa: SIM905

KEYS = """
    title experiment axes fixed sampling grid exclude published claim v_max n_obj model n_sim n_cat seed zip file source
    start stop step num spacing text exact tolerance slope ratio value variable over component of to at where precision
    max_n_sim keep_samples common_random_numbers method catalogue_file
""".split()  # noqa: SIM905

VALUE = re.compile(r"""=\s*("(?:[^"\\]|\\.)*"|\{[^{}]*\}|\[[^\[\]]*\]|[^\s,}\]\#"{\[]+)""")

Mutation = Callable[[str, random.Random], str]


def corpus() -> dict[str, str]:
    """Every built-in study, and every whole study that the documents show."""
    studies = {path.stem: path.read_text() for path in sorted((ROOT / "sweeps").glob("*.toml"))}
    for document in sorted((ROOT / "docs").glob("*.md")):
        blocks = re.findall(r"```toml[^\n]*\n(.*?)```", document.read_text(), flags=re.DOTALL)
        for number, block in enumerate(block for block in blocks if block.startswith("title")):
            studies[f"{document.stem}-{number}"] = block
    return studies


def _line(text: str, change: Callable[[list[str], int], None], chance: random.Random) -> str:
    lines = text.split("\n")
    change(lines, chance.randrange(len(lines)))
    return "\n".join(lines)


def flip_bytes(text: str, chance: random.Random) -> str:
    content = bytearray(text.encode())
    for _ in range(chance.randint(1, 3)):
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    return content.decode("latin-1")


def drop_line(text: str, chance: random.Random) -> str:
    return _line(text, lambda lines, i: lines.pop(i) and None, chance)


def double_line(text: str, chance: random.Random) -> str:
    return _line(text, lambda lines, i: lines.insert(i, lines[i]), chance)


def swap_lines(text: str, chance: random.Random) -> str:
    lines = text.split("\n")
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    return "\n".join(lines)


def cut(text: str, chance: random.Random) -> str:
    return text[: chance.randrange(len(text))]


def nasty_value(text: str, chance: random.Random) -> str:
    """Replace what stands after an equals sign, or a word, by something that ought not to be there."""
    places = [m.span(1) for m in VALUE.finditer(text)]
    start, stop = chance.choice(places)
    return text[:start] + chance.choice(NASTY) + text[stop:]


def misspell_key(text: str, chance: random.Random) -> str:
    places = [m.span(0) for m in re.finditer(r"\w+(?=\s*=)", text)]
    start, stop = chance.choice(places)
    key = text[start:stop]
    at = chance.randrange(len(key))
    return (
        text[:start]
        + chance.choice([key[:at] + key[at + 1 :], key + "s", key.upper(), chance.choice(KEYS)])
        + text[stop:]
    )


def add_line(text: str, chance: random.Random) -> str:
    new = chance.choice(
        [
            f"{chance.choice(KEYS)} = {chance.choice(NASTY)}",
            f"[{chance.choice(KEYS)}]",
            f"[[{chance.choice(KEYS)}]]",
            f"[{chance.choice(KEYS)}.{chance.choice(KEYS)}]",
            f"{chance.choice(KEYS)}.{chance.choice(KEYS)}.{chance.choice(KEYS)} = {chance.choice(NASTY)}",
        ]
    )
    return _line(text, lambda lines, i: lines.insert(i, new), chance)


def change_number(text: str, chance: random.Random) -> str:
    """Another number where one stands: the study may well be good."""
    places = [m.span(0) for m in re.finditer(r"(?<![\w.\"])\d+(\.\d+)?(?![\w.\"])", text)]
    start, stop = chance.choice(places)
    other = chance.choice(["0", "-1", "2", "17", "0.5", "16.25", "1e3", "1000000", "1e-9", "1e18", "4294967296"])
    return text[:start] + other + text[stop:]


def wrap_value(text: str, chance: random.Random) -> str:
    """A value as a list, a string or a table of itself."""
    places = [m.span(1) for m in VALUE.finditer(text)]
    start, stop = chance.choice(places)
    value = text[start:stop]
    return text[:start] + chance.choice([f"[{value}]", f"{{ values = [{value}] }}", f"'{value}'", "1"]) + text[stop:]


MUTATIONS: tuple[Mutation, ...] = (
    *(flip_bytes, drop_line, double_line, swap_lines, cut, nasty_value, nasty_value, nasty_value),
    *(misspell_key, add_line, change_number, change_number, wrap_value),
)


def mutants(seed: int, n: int) -> list[tuple[str, str]]:
    """Return ``n`` studies after one to three mutations, with what they are made from and how."""
    chance = random.Random(seed)
    studies = list(corpus().items())
    made = []
    for number in range(n):
        name, text = studies[number % len(studies)]
        steps = [chance.choice(MUTATIONS) for _ in range(chance.choice([1, 1, 1, 2, 3]))]
        for step in steps:
            try:
                text = step(text, chance)
            except (IndexError, ValueError):  # nothing left of the kind that it changes
                break
        made.append((f"{number} {name} {' '.join(step.__name__ for step in steps)}", text))
    return made
