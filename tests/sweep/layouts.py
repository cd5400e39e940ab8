# ruff: noqa: E501 (the code of each kind is a line)
"""Random small packages: a function ``f`` in ``main.py`` that reaches a constant through several modules."""

import random
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

PLACES = ("", "local/", "../lib/pkg/", "../lib/pkg/sub/")
"""Folders of modules, from the folder of ``main.py``: beside it, in a package there, in a package that PYTHONPATH finds."""

LINKS = {  # what a module has to define so that NAME(x) calls INNER(x), which IMPORT makes known there
    "call": "def NAME(x):\n    return INNER(x)",
    "inner import": "def NAME(x):\n    IMPORT\n    return INNER(x)",
    "method": "class C_NAME:\n    def run(self, x):\n        return INNER(x)\n\nNAME_object = C_NAME()\n\ndef NAME(x):\n    return NAME_object.run(x)",
    "base": "class B_NAME:\n    def run(self, x):\n        return INNER(x)\n\nclass C_NAME(B_NAME):\n    pass\n\nNAME = C_NAME().run",
    "callable": "class C_NAME:\n    def __call__(self, x):\n        return INNER(x)\n\nNAME = C_NAME()",
    "property": "class C_NAME:\n    @property\n    def value(self):\n        return INNER(0.0)\n\ndef NAME(x):\n    return x + C_NAME().value",
    "static": "class C_NAME:\n    @staticmethod\n    def run(x):\n        return INNER(x)\n\ndef NAME(x):\n    return C_NAME.run(x)",
    "cached": "import functools\n\n@functools.lru_cache\ndef NAME(x):\n    return INNER(x)",
    "vectorised": "import numpy as np\n\nNAME_v = np.vectorize(lambda x: INNER(x))\n\ndef NAME(x):\n    return float(NAME_v(x))",
    "wrapped": "import functools\n\ndef NAME_deco(g):\n    @functools.wraps(g)\n    def inner(x):\n        return g(x)\n    return inner\n\n@NAME_deco\ndef NAME(x):\n    return INNER(x)",
    "registry": "NAME_all = {}\n\ndef NAME_add(g):\n    NAME_all[g.__name__] = g\n    return g\n\n@NAME_add\ndef one(x):\n    return INNER(x)\n\ndef NAME(x):\n    return NAME_all['one'](x)",
    "table": "NAME_all = {'one': lambda x: INNER(x), 'two': len}\n\ndef NAME(x):\n    return NAME_all['one'](x)",
    "partial": "import functools\n\ndef NAME_two(k, x):\n    return INNER(x) + k\n\nNAME = functools.partial(NAME_two, 0.0)",
    "closure": "def NAME_make(g):\n    return lambda x: g(x)\n\nNAME = NAME_make(lambda x: INNER(x))",
    "memory": "NAME_known = {}\n\ndef NAME(x):\n    if x not in NAME_known:\n        NAME_known[x] = INNER(x)\n    return NAME_known[x]",
    "counter": "class C_NAME:\n    def __init__(self):\n        self.calls = 0\n    def run(self, x):\n        self.calls += 1\n        return INNER(x)\n\nNAME = C_NAME().run",
    "nonlocal": "def NAME_make():\n    n = 0\n    def inner(x):\n        nonlocal n\n        n += 1\n        return INNER(x)\n    return inner\n\nNAME = NAME_make()",
    "default memory": "def NAME(x, known={}):\n    known[x] = INNER(x)\n    return known[x]",
    "lazy": "import functools\n\nclass C_NAME:\n    def __init__(self):\n        self.first = None\n    @functools.cached_property\n    def zero(self):\n        return 0.0\n    def run(self, x):\n        if self.first is None:\n            self.first = [x]\n        return INNER(x) + self.zero\n\nNAME_object = C_NAME()\n\ndef NAME(x):\n    return NAME_object.run(x)",
    "class decorator": "import functools\n\nclass D_NAME:\n    def __init__(self, g):\n        functools.update_wrapper(self, g)\n        self.g = g\n    def __call__(self, x):\n        return self.g(x) + INNER(x)\n\n@D_NAME\ndef NAME(x):\n    return 0.0",
    "attribute of itself": "def NAME(x):\n    NAME.calls = getattr(NAME, 'calls', 0) + 1\n    return INNER(x)",
    "single dispatch": "import functools\n\n@functools.singledispatch\ndef NAME(x):\n    return INNER(x)",
}

ENDS = {  # how the constant, CONSTANT, comes into NAME(x)
    "literal": "def NAME(x):\n    return x + CONSTANT",
    "global": "K_NAME = CONSTANT\n\ndef NAME(x):\n    return x + K_NAME",
    "default": "def NAME(x, k=CONSTANT):\n    return x + k",
    "keyword": "def NAME(x, *, k=CONSTANT):\n    return x + k",
    "class": "class C_NAME:\n    k = CONSTANT\n\ndef NAME(x):\n    return x + C_NAME.k",
    "instance": "class C_NAME:\n    def __init__(self, k):\n        self.k = k\n\nNAME_object = C_NAME(CONSTANT)\n\ndef NAME(x):\n    return x + NAME_object.k",
    "configured": "class C_NAME:\n    k = 0.0\n    def configure(self, k):\n        self.k = k\n\nNAME_object = C_NAME()\nNAME_object.configure(CONSTANT)\n\ndef NAME(x):\n    return x + NAME_object.k",
    "dict": "D_NAME = {'k': CONSTANT, 'names': {'a', 'b', 'c', 'dd', 'eee'}}\n\ndef NAME(x):\n    return x + D_NAME['k']",
    "array": "import numpy as np\n\nA_NAME = np.array([0.0, CONSTANT])\n\ndef NAME(x):\n    return x + float(A_NAME[1])",
    "closure": "def NAME_make(k):\n    def inner(x):\n        return x + k\n    return inner\n\nNAME = NAME_make(CONSTANT)",
    "decorator": "def NAME_scaled(k):\n    def deco(g):\n        def inner(x):\n            return g(x) + k\n        return inner\n    return deco\n\n@NAME_scaled(CONSTANT)\ndef NAME(x):\n    return x",
    "attribute": "def NAME(x):\n    return x + NAME.k\n\nNAME.k = CONSTANT",
    "like a counter": "class A_NAME:\n    def __init__(self, k):\n        self.k = k\n\nclass C_NAME:\n    k = 0\n    def step(self):\n        self.k += 1\n\nNAME_object = A_NAME(CONSTANT)\n\ndef NAME(x):\n    C_NAME().step()\n    return x + NAME_object.k",
    "decorated method": "import functools\n\ndef NAME_deco(g):\n    @functools.wraps(g)\n    def inner(*args):\n        return g(*args)\n    return inner\n\nclass C_NAME:\n    def __init__(self, k):\n        self.k = k\n    @NAME_deco\n    def run(self, x):\n        return x + self.k\n\nNAME_all = [C_NAME(CONSTANT).run]\n\ndef NAME(x):\n    return NAME_all[0](x)",
    "later": "class C_NAME:\n    k = 0.0\n\nC_NAME.k = CONSTANT\n\ndef NAME(x):\n    return x + C_NAME().k",
    "dataclass": "from dataclasses import dataclass, field\n\n@dataclass(frozen=True)\nclass C_NAME:\n    k: float = CONSTANT\n    names: frozenset = frozenset({'a', 'b', 'c', 'dd'})\n\ndef NAME(x):\n    return x + C_NAME().k",
    "enum": "from enum import Enum\n\nclass E_NAME(Enum):\n    K = CONSTANT\n\ndef NAME(x):\n    return x + E_NAME.K.value",
    "partial": "import functools\n\ndef NAME_two(k, x):\n    return x + k\n\nNAME = functools.partial(NAME_two, CONSTANT)",
    "tuple": "T_NAME = (0.0, CONSTANT)\n\ndef NAME(x):\n    return x + T_NAME[1]",
    "computed": "def NAME_k():\n    return 2.0 * CONSTANT\n\nK_NAME = NAME_k()\n\ndef NAME(x):\n    return x + K_NAME",
    "named": "from collections import namedtuple\n\nP_NAME = namedtuple('P', 'k other')(CONSTANT, 0)\n\ndef NAME(x):\n    return x + P_NAME.k",
    "frozen": "import scipy.stats\n\nS_NAME = scipy.stats.norm(CONSTANT, 1.0)\n\ndef NAME(x):\n    return x + float(S_NAME.mean())",
    "nested": "def NAME(x):\n    def inner(y):\n        return y + CONSTANT\n    return inner(x)",
    "seed": "import numpy as np\n\ndef NAME(x):\n    return x + float(np.random.default_rng(int(CONSTANT)).normal())",
    "state": "import decimal\n\ndecimal.getcontext().prec = int(CONSTANT)\n\ndef NAME(x):\n    return float(decimal.Decimal(1) / decimal.Decimal(3)) + x",
    "mutated": "M_NAME = {'k': CONSTANT}\n\ndef NAME(x):\n    M_NAME['calls'] = 1\n    return x + M_NAME['k']",
}


@dataclass
class Layout:
    """Modules by their paths; each is a list of blocks of definitions in any order."""

    seed: int
    kinds: list[str] = field(default_factory=list)

    def write(self, folder: Path, constant: str = "3.0", *, cosmetic: bool = False) -> None:
        """Write the modules below a folder, ``main.py`` in ``work/``; ``cosmetic`` changes what changes no number."""
        chance = random.Random(self.seed)
        other = random.Random(f"other {self.seed}")
        self.kinds.clear()
        self._reexported: list[tuple[str, str]] = []
        depth = chance.randint(0, 3)
        modules: dict[str, list[str]] = {"main.py": []}
        heads: dict[str, list[str]] = {"main.py": []}
        path, name = "main.py", "f"
        for level in range(depth + 1):
            if level == depth:
                self.kinds.append(kind := chance.choice(sorted(ENDS)))
                text = ENDS[kind].replace("CONSTANT", constant)
            else:
                self.kinds.append(kind := chance.choice(sorted(LINKS)))
                places = [place for place in PLACES if place.startswith("../") or not path.startswith("../")]
                inner, inner_path = f"g{level}", chance.choice(places) + f"m{level}.py"  # no circle of packages
                statement, call = self._import(chance, path, inner_path, inner, at_top=kind != "inner import")
                text = LINKS[kind].replace("INNER", call).replace("IMPORT", statement)
                if kind != "inner import":
                    heads[path].append(statement)
            block = text.replace("NAME", name if level else "h")
            modules[path].append(block)
            if level < depth:
                path, name = inner_path, inner
                modules.setdefault(path, [])
                heads.setdefault(path, [])
        modules["main.py"].append("def f(x: float = 1.0):\n    return h(x)")
        for file, blocks in modules.items():
            dead = "7.0" if not cosmetic else "8.0"
            blocks.insert(0, f"def unused(x):\n    return x * {dead}")
            body = [textwrap.dedent(block) for block in blocks]
            if cosmetic:
                other.shuffle(body)
                body = [f"# {other.random()}\n{block}" for block in body]
                body = [_with_docstrings(block) for block in body]
            where = (folder / "work" / file).resolve()
            where.parent.mkdir(parents=True, exist_ok=True)
            text = "\n\n\n".join(["\n".join(dict.fromkeys(heads[file])), *body]) + "\n"
            where.write_text(text if not cosmetic else f'"""A module."""\n{text}')
        for package in ("work/local", "lib/pkg", "lib/pkg/sub"):
            (folder / package).mkdir(parents=True, exist_ok=True)
            exported = [
                f"from .{Path(file).stem} import {name}"
                for file, name in self._reexported
                if (folder / "work" / file).resolve().parent == (folder / package).resolve()
            ]
            (folder / package / "__init__.py").write_text("\n".join(exported) + "\n")

    def _import(self, chance: random.Random, path: str, inner_path: str, inner: str, at_top: bool) -> tuple[str, str]:
        """Return an import statement in one module for a function of another, and how it is called there."""
        module = inner_path.removesuffix(".py").removeprefix("../lib/").replace("/", ".")
        package, _, last = module.rpartition(".")
        ways = [
            (f"from {module} import {inner}", f"{inner}"),
            (f"import {module} as other_{inner}", f"other_{inner}.{inner}"),
            (f"import {module}", f"{module}.{inner}"),
            (f"from {module} import {inner} as renamed_{inner}", f"renamed_{inner}"),
        ]
        if at_top:
            ways.append((f"from {module} import *", inner))
        if package:
            ways.append((f"from {package} import {last}", f"{last}.{inner}"))
        if package and path.rpartition("/")[0] == inner_path.rpartition("/")[0]:
            ways.append((f"from .{last} import {inner}", inner))
            ways.append((f"from . import {last}", f"{last}.{inner}"))
        if package and not path.startswith(inner_path.rpartition("/")[0]):
            self._reexported.append((inner_path, inner))
            ways.append((f"from {package} import {inner}", inner))
        statement, call = chance.choice(ways)
        self.kinds.append(statement)
        return statement, call


def _with_docstrings(block: str) -> str:
    lines: list[str] = []
    for line in block.splitlines():
        lines.append(line)
        if line.lstrip().startswith("def ") and line.endswith(":"):
            lines.append(f'{" " * (len(line) - len(line.lstrip()) + 4)}"""Return a number."""')
    return "\n".join(lines)
