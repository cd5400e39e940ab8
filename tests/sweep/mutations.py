"""Mutilated study files: what a slip of the hand, a bad editor or malice make of a good one."""

import random
import re
from collections.abc import Callable

from tests.documents import ROOT, code

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
VALUE = r"""=\s*("(?:[^"\\]|\\.)*"|\{[^{}]*\}|\[[^\[\]]*\]|[^\s,}\]\#"{\[]+)"""
NUMBERS = ("0", "-1", "2", "17", "0.5", "16.25", "1e3", "1000000", "1e-9", "1e18", "4294967296")


def corpus() -> dict[str, str]:
    studies = {path.stem: path.read_text() for path in sorted((ROOT / "sweeps").glob("*.toml"))}
    for document in sorted((ROOT / "docs").glob("*.md")):
        whole = [block for block in code(document.name, "toml") if block.startswith("title")]
        studies |= {f"{document.stem}-{number}": block for number, block in enumerate(whole)}
    return studies


def lines_changed(text: str, chance: random.Random) -> str:
    lines = text.split("\n")
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    key, value = chance.choice(KEYS), chance.choice(NASTY)
    new = chance.choice([f"{key} = {value}", f"[{key}]", f"[[{key}]]", f"{key}.{chance.choice(KEYS)} = {value}"])
    rest = [lines[i + 1 :], [lines[i], *lines[i:]], [lines[j], *lines[i + 1 :]], [new, *lines[i:]], [lines[i][:5]]]
    return "\n".join([*lines[:i], *chance.choice(rest)])


def bytes_flipped(text: str, chance: random.Random) -> str:
    content = bytearray(text.encode())
    for _ in range(chance.randint(1, 3)):
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    return content.decode("latin-1")


def replaced(text: str, chance: random.Random, pattern: str, change: Callable[[str], str], group: int = 0) -> str:
    result = chance.choice(list(re.finditer(pattern, text)))
    start, stop = result.span(group)
    return text[:start] + change(result[group]) + text[stop:]


def value_changed(text: str, chance: random.Random) -> str:
    wrapped = chance.choice(["{}", "[{}]", "{{ values = [{}] }}", "'{}'"])
    nasty = chance.choice(NASTY)
    return replaced(text, chance, VALUE, lambda value: nasty if wrapped == "{}" else wrapped.format(value), 1)


def key_misspelt(text: str, chance: random.Random) -> str:
    def other(key: str) -> str:
        at = chance.randrange(len(key))
        return chance.choice([key[:at] + key[at + 1 :], key + "s", key.upper(), chance.choice(KEYS)])

    return replaced(text, chance, r"\w+(?=\s*=)", other)


def number_changed(text: str, chance: random.Random) -> str:
    return replaced(text, chance, r"(?<![\w.\"])\d+(\.\d+)?(?![\w.\"])", lambda _: chance.choice(NUMBERS))


MUTATIONS = (lines_changed, lines_changed, bytes_flipped, value_changed, value_changed, key_misspelt, number_changed)


def mutants(seed: int, n: int) -> list[tuple[str, str]]:
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
