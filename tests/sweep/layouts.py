# ruff: noqa: E501 (the code of each kind is a line)
"""Random small packages: a function ``f`` in ``main.py`` that reaches a constant through several modules."""

import random
import re
from dataclasses import dataclass, field
from pathlib import Path

# Beside main.py, in a package there, and in a package that PYTHONPATH finds.
PLACES = ("", "local/", "../lib/pkg/", "../lib/pkg/sub/")
LINKS = {  # what a module has to define so that NAME(x) calls INNER(x), which IMPORT makes known there
    "call": "import typing\n\nT_NAME = typing.TypeVar('T_NAME')\n\ndef NAME(x: T_NAME):\n    return INNER(x)",
    "inner import": "def NAME(x):\n    IMPORT\n    return INNER(x)",
    "method": "class C_NAME:\n    def run(self, x):\n        return INNER(x)\n\nNAME_object = C_NAME()\n\ndef NAME(x):\n    return NAME_object.run(x)",
    "property": "class C_NAME:\n    @property\n    def value(self):\n        return INNER(0.0)\n\ndef NAME(x):\n    return x + C_NAME().value",
    "cached": "import functools\n\n@functools.lru_cache\ndef NAME(x):\n    return INNER(x)",
    "vectorised": "import numpy as np\n\nNAME_v = np.vectorize(lambda x: INNER(x))\n\ndef NAME(x):\n    return float(NAME_v(x))",
    "wrapped": "import functools\n\ndef NAME_deco(g):\n    @functools.wraps(g)\n    def inner(x):\n        return g(x)\n    return inner\n\n@NAME_deco\ndef NAME(x):\n    return INNER(x)",
    "registry": "NAME_all = {}\n\ndef NAME_add(g):\n    NAME_all[g.__name__] = g\n    return g\n\n@NAME_add\ndef one(x):\n    return INNER(x)\n\ndef NAME(x):\n    return NAME_all['one'](x)",
    "partial": "import functools, toolz\n\n@toolz.curry\ndef NAME_two(k, x):\n    return INNER(x) + k\n\nNAME = functools.partial(NAME_two, 0.0)",
    "closure": "def NAME_make(g):\n    return lambda x: g(x)\n\nNAME = NAME_make(lambda x: INNER(x))",
    "counter": "B_NAME_all = {}\n\nclass B_NAME:\n    one, n = None, 0\n    def __new__(cls):\n        cls.one = cls.one or super().__new__(cls)\n        return cls.one\n    def __init__(self):\n        B_NAME_all['n'] = type(self).n = self.n + 1\n\nclass A_NAME(B_NAME):\n    pass\n\nclass C_NAME:\n    def __init__(self):\n        self.calls = 0\n    @property\n    def late(self):\n        if not hasattr(self, 'made'):\n            self.made = 0.0\n        return self.made\n    def run(self, x, known={}):\n        self.calls, known[x] = self.calls + 1, A_NAME()\n        return INNER(x) + self.late\n\nNAME = C_NAME().run",
    "lazy": "import functools\n\nclass C_NAME:\n    def __init__(self):\n        self.first = None\n    @functools.cached_property\n    def zero(self):\n        return 0.0\n    def run(self, x):\n        if self.first is None:\n            self.first = [x]\n        return INNER(x) + self.zero\n\nNAME_object = C_NAME()\n\ndef NAME(x):\n    return NAME_object.run(x)",
    "own names": "from dataclasses import dataclass\n\n@dataclass\nclass C_NAME:\n    k: float = 1.0\n    n = 2.0\n    m = n * 2\n    g: object = None\n    def run(self, y):\n        return self.g(y)\n\nNAME_all = {'a': lambda v: INNER(v)} | {i: j for i, j in [(1, 2)]}\n\ndef NAME(x):\n    NAME_all[x] = x\n    return C_NAME(g=NAME_all['a']).run(x)",
    "registered later": "import abc, functools\n\nclass A_NAME(abc.ABC):\n    pass\n\nA_NAME.register(float)\n\n@functools.singledispatch\ndef NAME(x):\n    return 0.0\n\n@NAME.register\ndef _(x: A_NAME):\n    return INNER(x)",
    "method set later": "class C_NAME:\n    pass\n\nC_NAME.run = lambda self, x: INNER(x)\n\ndef NAME(x):\n    return C_NAME().run(x)",
    "metaclass": "class M_NAME(type):\n    def __call__(cls, x):\n        return INNER(x)\n\nclass NAME(metaclass=M_NAME):\n    pass",
    "descriptor": "class D_NAME:\n    def __get__(self, one, kind=None):\n        return INNER\n\nclass C_NAME:\n    run = D_NAME()\n\ndef NAME(x):\n    return C_NAME().run(x)",
    "subclasses": "class B_NAME:\n    def __init_subclass__(cls):\n        B_NAME.last = cls\n\nclass C_NAME(B_NAME):\n    def run(self, x):\n        return INNER(x)\n\ndef NAME(x):\n    return B_NAME.last().run(x)",
    "only imported": "import numpy\n\ndef NAME(x):\n    return x + numpy.NAME_here",
    "given to an object": "class A_NAME:\n    def __init__(self):\n        self.table, self.calls = {}, 0\n    def add(self, name):\n        def keep(g):\n            self.table[name] = g\n            return g\n        return keep\n    def run(self, name, x):\n        self.calls += 1\n        return self.table[name](x)\n\nA_NAME_all = A_NAME()\n\n@A_NAME_all.add('one')\ndef NAME_one(x):\n    return INNER(x)\n\ndef NAME(x):\n    return A_NAME_all.run('one', x)",
}
ENDS = {  # how the constant, CONSTANT, comes into NAME(x)
    "changes a name of its own": "def NAME_one(w):\n    w[0] = 0.0\n    return w[0]\n\nNAME_k = [CONSTANT]\nw = vars()['NAME_' + 'k']\n\ndef NAME(x):\n    return NAME_one([x]) + w[0]",
    "global": "K_NAME = CONSTANT\n\ndef NAME(x):\n    class C_NAME:\n        K_NAME = K_NAME\n    return x + C_NAME.K_NAME",
    "default": "NAME_all = [lambda x, i=i: x + i for i in range(3)]\n\ndef NAME(x, k=CONSTANT):\n    return NAME_all[0](x) + k",
    "keyword": "def NAME(x, *, k=CONSTANT, own=lambda v: v):\n    return x + k",
    "instance": "S_NAME = []\n\nclass C_NAME:\n    def __init__(self, k):\n        self.k = k\n        S_NAME.append(self)\n\nNAME_object = C_NAME(CONSTANT)\n\ndef NAME(x):\n    return x + sum(one.k for one in S_NAME if isinstance(one, C_NAME))",
    "configured": "class C_NAME:\n    k = 0.0\n    def configure(self, k):\n        self.k = k\n\nNAME_object = C_NAME()\nNAME_object.configure(CONSTANT)\n\ndef NAME(x):\n    return x + NAME_object.k",
    "dict": "D_NAME = {'k': CONSTANT, 'names': {'a', 'b', 'c', 'dd', 'eee'}}\n\ndef NAME(x):\n    return x + D_NAME['k']",
    "closure": "def NAME_make(k):\n    def inner(x):\n        return x + k\n    return inner\n\nNAME = NAME_make(CONSTANT)",
    "attribute": "def NAME(x):\n    return x + NAME.k\n\nNAME.k = CONSTANT",
    "like a counter": "class A_NAME:\n    def __init__(self, k):\n        self.k = k\n\nclass C_NAME:\n    k = 0\n    def step(self):\n        self.k += 1\n\nNAME_object = A_NAME(CONSTANT)\n\ndef NAME(x):\n    C_NAME().step()\n    return x + NAME_object.k",
    "decorated method": "import functools\n\ndef NAME_deco(g):\n    @functools.wraps(g)\n    def inner(*args):\n        return g(*args)\n    return inner\n\nclass C_NAME:\n    def __init__(self, k):\n        self.k = k\n    @NAME_deco\n    def run(self, x):\n        return x + self.k\n\nNAME_all = [C_NAME(CONSTANT).run]\n\ndef NAME(x):\n    return NAME_all[0](x)",
    "method in a library's wrapper": "import numpy as np\n\nclass C_NAME:\n    def __init__(self, k):\n        self.k = k\n    def run(self, x):\n        return x + self.k\n\nNAME_one = np.errstate()(C_NAME(CONSTANT).run)\n\ndef NAME(x):\n    return NAME_one(x)",
    "number of a decorator": "import functools\n\nK_NAME = int(CONSTANT)\n\n@functools.lru_cache(maxsize=K_NAME)\ndef NAME_one(x):\n    return x\n\ndef NAME(x):\n    return x + NAME_one.cache_parameters()['maxsize']",
    "later": "class C_NAME:\n    k = 0.0\n\nC_NAME.k = CONSTANT\n\ndef NAME(x):\n    return x + C_NAME().k",
    "dataclass": "from dataclasses import dataclass, field\n\n@dataclass(frozen=True)\nclass C_NAME:\n    k: float = CONSTANT\n    names: frozenset = frozenset({'a', 'b', 'c', 'dd'})\n\ndef NAME(x):\n    return x + C_NAME().k",
    "enum": "from enum import Enum\n\nclass E_NAME(Enum):\n    K = CONSTANT\n\ndef NAME(x):\n    return x + E_NAME.K.value",
    "methods in any order": "def NAME_deco(g):\n    def inner(self, x):\n        return g(self, x)\n    return inner\n\nclass C_NAME:\n# 1\n    @NAME_deco\n    def one(self, x):\n        return x\n\n# 2\n    @NAME_deco\n    def two(self, x):\n        return x + CONSTANT\n\n# 3\n\ndef NAME(x):\n    return C_NAME().one(x) - C_NAME().two(x)",
    "every subclass": "class B_NAME:\n    pass\n\ndef NAME_every(kind):\n    return [one for each in kind.__subclasses__() for one in (each, *NAME_every(each))]\n\nclass A_NAME(B_NAME):\n    k = 0.0\n\nclass C_NAME(A_NAME):\n    k = CONSTANT\n\ndef NAME(x):\n    return x + sum(one.k for one in NAME_every(B_NAME))",
    "state": "import decimal\n\ndecimal.getcontext().prec = int(CONSTANT)\n\ndef NAME(x):\n    return float(decimal.Decimal(1) / decimal.Decimal(3)) + x",
    "factory": "from dataclasses import dataclass, field\n\ndef NAME_k():\n    return [CONSTANT]\n\n@dataclass\nclass C_NAME:\n    k: list = field(default_factory=NAME_k)\n\ndef NAME(x):\n    return x + C_NAME().k[0]",
    "classes exchanged": "def NAME_make(start):\n    class C_NAME:\n        K = start\n    return C_NAME\n\nA_NAME, B_NAME = map(NAME_make, (CONSTANT, 7 - CONSTANT))\nS_NAME = {NAME_make(k) for k in range(9)}\n\ndef NAME(x):\n    return x + A_NAME.K + 2 * B_NAME.K + sum(one.K for one in S_NAME)",
    "series": "import pandas as pd\n\nS_NAME = pd.Series([0.0, CONSTANT])\n\ndef NAME(x):\n    return x + float(S_NAME.iloc[1])",
    "spline": "import numpy as np\nfrom scipy.interpolate import CubicSpline\n\nS_NAME = CubicSpline(np.arange(4.0), np.arange(4.0) * CONSTANT)\n\ndef NAME(x):\n    return x + float(S_NAME(1.0))",
    "frompyfunc": "import numpy as np\n\nU_NAME = np.frompyfunc(lambda x: x + CONSTANT, 1, 1)\n\ndef NAME(x):\n    return float(U_NAME(x))",
    "single dispatch method": "import functools\n\nclass C_NAME:\n    @functools.singledispatchmethod\n    def run(self, x):\n        return -1.0\n    @run.register\n    def _(self, x: float):\n        return x + CONSTANT\n\ndef NAME(x):\n    return C_NAME().run(float(x))",
    "exec": "exec('def NAME_one(x):\\n    return x')\n\nNAME = eval('lambda x: NAME_one(x) + CONSTANT')",
    "exec of a global": "D_NAME = {'K': CONSTANT}\nexec('def one(x):\\n    return x + K', D_NAME)\n\nNAME = D_NAME['one']",
    "given to a library": "from dask.sizeof import sizeof\n\nclass C_NAME:\n    pass\n\n@sizeof.register(C_NAME)\ndef NAME_size(one):\n    return CONSTANT\n\ndel NAME_size\n\ndef NAME(x):\n    return x + sizeof(C_NAME())",
    "class given to a library": "import dask.sizeof\n\n@dask.sizeof.sizeof.register(frozenset)\nclass NAME_size(float):\n    k = CONSTANT\n    def __new__(cls, one):\n        return cls.k\n\ndef NAME(x):\n    return x + dask.sizeof.sizeof(frozenset())",
    "given to what changes": "NAME_all = {}\n\ndef NAME_given(g):\n    NAME_all[g.__name__] = g\n    return g\n\n@NAME_given\ndef NAME_one(x):\n    return x + CONSTANT\n\ndef NAME(x):\n    NAME_all.setdefault('n', 0)\n    return NAME_all['NAME_one'](x)",
    "code replaced": "def NAME_other(x):\n    return x + CONSTANT\n\ndef NAME(x):\n    return x\n\nNAME.__code__ = NAME_other.__code__",
    "function copied": "import types\n\ndef NAME_one(x):\n    return x + K\n\nNAME = types.FunctionType(NAME_one.__code__, {'K': CONSTANT})",
    "global in helper": "K_NAME = 0.0\n\ndef NAME_init():\n    global K_NAME\n    K_NAME = CONSTANT\n\nNAME_init()\n\ndef NAME(x):\n    return x + K_NAME",
    "cyclic list": "L_NAME = [CONSTANT]\nL_NAME.append(L_NAME)\n\ndef NAME(x):\n    return x + L_NAME[1][1][0]",
    "lambda of a line": "L_NAME = [lambda x: x, lambda x: -x, lambda x: 1.0, lambda x: x + 1.0, lambda x: x + 2.0][int(CONSTANT)]\n\ndef NAME(x):\n    return L_NAME(x) + 1.0",
    "set of closures": "def NAME_make(k):\n    return lambda x: x + k\n\nNAME_all = {NAME_make(k) for k in (CONSTANT, *range(20))}\n\ndef NAME(x):\n    return sum(one(x) for one in NAME_all)",
    "private": "_C_NAME__K = CONSTANT\n\nclass C_NAME:\n    def run(self, x):\n        return x + __K\n\ndef NAME(x):\n    return C_NAME().run(x)",
    "closure that changes": "def NAME_make(k):\n    s = {'k': k}\n    def inner(x):\n        s['calls'] = 1\n        return x + s['k']\n    return inner\n\nNAME_one = NAME_make(CONSTANT)\n\ndef NAME(x):\n    return NAME_one(x)",
    "hook of a class": "class B_NAME:\n    S = {}\n    def __init_subclass__(cls, k=0.0):\n        B_NAME.S['k'] = k\n\nclass C_NAME(B_NAME, k=CONSTANT):\n    pass\n\ndef NAME(x):\n    B_NAME.S.setdefault('calls', 0)\n    return x + B_NAME.S['k']",
    "place": "import pathlib\n\nNAME_here = pathlib.Path(__file__).resolve().parents[1]\nNAME_all = {'k': CONSTANT, 'at': str(NAME_here)}\n\ndef NAME(x, at=NAME_here / 'a'):\n    return x + NAME_all['k'] + len(at.relative_to(NAME_all['at']).parts)",
    "left out of pickles": "class C_NAME:\n    def __init__(self, k):\n        self.k = k\n    def __getstate__(self):\n        return {}\n\nNAME_object = C_NAME(CONSTANT)\n\ndef NAME(x):\n    return x + NAME_object.k",
    "beside a lock": "import threading\n\nL_NAME = threading.Lock()\n\ndef NAME(x):\n    with L_NAME:\n        return x + CONSTANT",
}
UNUSED = """  # definitions that nothing reaches
g = i = j = k = m = n = v = value = y = run = OTHER
import click, dataclasses, linksweep, numpy
def unused(x):
    return x * OTHER
@dataclasses.dataclass
class Unused:
    k: float = OTHER
    @numpy.vectorize
    def unused(self):
        return OTHER
@click.command
@click.option("--k", default=OTHER)
def command(k):
    print(OTHER)
@linksweep.experiment(outputs={"declared": "m"})
def declared(x: float):
    return x * OTHER
"""


@dataclass
class Layout:
    """Modules by their paths; each is a list of blocks of definitions in any order."""

    seed: int
    kinds: list[str] = field(default_factory=list)
    only: str = ""  # kind, instead of random ones

    def write(self, folder: Path, constant: str = "3.0", *, cosmetic: bool = False) -> None:
        """Write the modules below a folder, ``main.py`` in ``project/``; ``cosmetic`` changes what changes no number."""
        chance, other = random.Random(self.seed), random.Random(f"other {self.seed}")
        self.kinds.clear()
        self._reexported: list[tuple[str, str]] = []
        modules: dict[str, list[str]] = {}  # the import of each, and its definitions
        path, name, effect = "main.py", "h", ""
        for level in range(chance.randint(0, 3) if not self.only else int(self.only in LINKS)):
            self.kinds.append(kind := self.only or chance.choice(sorted(LINKS)))
            places = [place for place in PLACES if place.startswith("../") or not path.startswith("../")]
            inner, inner_path = f"g{level}", chance.choice(places) + f"m{level}.py"  # no circle of packages
            at_top = "IMPORT" not in LINKS[kind]
            statement, call = self._import(chance, path, inner_path, inner, at_top)
            text = LINKS[kind].replace("INNER", call).replace("IMPORT", statement)
            modules[path] = [statement * at_top, text.replace("NAME", name)]
            modules[path][1] += effect
            effect = f"\n\nimport numpy\n\nnumpy.{name}_here = {inner}(0.0)" if kind == "only imported" else ""
            path, name = inner_path, inner
        self.kinds.append(kind := self.only if self.only in ENDS else chance.choice(sorted(ENDS)))
        modules[path] = ["", ENDS[kind].replace("CONSTANT", constant).replace("NAME", name) + effect]
        modules["main.py"].append("import alone\n\nALL = [alone, 1]\n\ndef f(x: float):\n    return h(x) if ALL else x")
        for file, (head, *blocks) in modules.items():
            body = [*blocks, UNUSED.replace("OTHER", "8.0" if cosmetic else "7.0")]
            if cosmetic:
                other.shuffle(body)
                body = [re.sub("(?s)(# 1.*)(# 2.*)(# 3)", r"\2\1\3", block) for block in body]
                body = [re.sub(r"(?m)^( *)def .*:$", r'\g<0>\n\1    """Sum."""\n\1    "Old"', block) for block in body]
                body = [f"# {other.random()}\n{block}" for block in body]
            where = (folder / "project" / file).resolve()
            where.parent.mkdir(parents=True, exist_ok=True)
            where.write_text('"""A module."""\n' * cosmetic + "\n\n\n".join([head, *body]) + "\n")
        for package in ("project/alone", "project/local", "lib/pkg", "lib/pkg/sub"):
            (folder / package).mkdir(parents=True, exist_ok=True)
            files = [((folder / "project" / file).resolve(), name) for file, name in self._reexported]
            here = [(file.stem, name) for file, name in files if file.parent == (folder / package).resolve()]
            exported = "".join(f"from .{module} import {name}\n" for module, name in here)
            reads = "import importlib.resources\n\nHERE = importlib.resources.files(__name__).joinpath('__init__.py').read_text()\n"
            (folder / package / "__init__.py").write_text(reads + exported)

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
        ways += [(f"from {module} import *", inner)] * at_top
        ways += [(f"from {package} import {last}", f"{last}.{inner}")] * bool(package)
        if package and path.rpartition("/")[0] == inner_path.rpartition("/")[0]:
            ways += [(f"from .{last} import {inner}", inner), (f"from . import {last}", f"{last}.{inner}")]
        if package and not path.startswith(inner_path.rpartition("/")[0]):
            self._reexported.append((inner_path, inner))
            ways.append((f"from {package} import {inner}", inner))
        statement, call = chance.choice(ways)
        self.kinds.append(statement)
        return statement, call
