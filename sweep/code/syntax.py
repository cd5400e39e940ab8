"""The syntax of a user's code: where it is, which names it refers to, and what it changes while it runs."""

import ast
import copy
import linecache
import os
import symtable
import sys
import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from types import CodeType, FunctionType, ModuleType
from typing import Any

from linksweep.sweep.code.files import local_files_of, without_package
from linksweep.sweep.contract import SweepError

PLAIN = (bool, int, float, complex, str, bytes)

CHANGING = {
    *("append", "add", "extend", "update", "insert", "setdefault", "pop", "popitem", "clear"),
    *("discard", "remove", "sort", "reverse", "write", "put", "acquire"),
}
"""Methods that change their object."""

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Names = Mapping[str, Any]
Key = tuple[Any, ...]

_BEGAN = time.time()


def label_of(value: Any) -> str:
    """Return the module and name of a function or class, the same in all processes."""
    return without_package(f"{value.__module__}.{value.__qualname__}")


def cells_of(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the names in a function's closure with their values."""
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not filled yet
            yield name, cell.cell_contents


def tree_of(filename: str, names: Names) -> ast.Module | None:
    """Return the syntax tree of the file, cell or argument that some code is from; None where there is no source."""
    files = local_files_of(names.get("__name__") or "")
    if files is not None and (file := files.name_of(filename)) is not None:
        return files.tree(file)
    return _parsed(_source(filename, names))


def statements_of(filename: str, names: Names) -> list[ast.stmt]:
    """Return the statements of a module; none where there is no source."""
    tree = tree_of(filename, names)
    return [] if tree is None else tree.body


def _source(filename: str, names: Names) -> str:
    if not filename.endswith(".py") and not filename.startswith("<") and "ipykernel" not in filename:
        return ""
    linecache.checkcache(filename)
    text = "".join(linecache.getlines(filename, dict(names)))
    if not text and filename == "<string>" and "-c" in sys.orig_argv and names.get("__name__") == "__main__":
        text = sys.orig_argv[sys.orig_argv.index("-c") + 1]
    return text


@lru_cache(maxsize=256)
def _parsed(text: str) -> ast.Module | None:
    try:
        return ast.parse(text) if text else None
    except SyntaxError:  # a cell with commands of IPython
        return None


@lru_cache(maxsize=256)
def _functions(tree: ast.Module) -> dict[tuple[int, str], list[Function]]:
    """Return functions by the line that they begin in, decorators included, and their name."""
    functions: dict[tuple[int, str], list[Function]] = {}
    for node in ast.walk(tree):
        if isinstance(node, Function):
            first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            functions.setdefault((first, getattr(node, "name", "<lambda>")), []).append(node)
    return functions


def definitions_of(function: FunctionType) -> Sequence[Function]:
    """Return the definition of a function; that of all lambdas in its line, none where there is no source.

    Raises SweepError where its file has changed since it was imported: what it computes is no longer what is there.
    """
    code, names = function.__code__, function.__globals__
    if (tree := tree_of(code.co_filename, names)) is None:
        return ()
    with suppress(OSError):  # a cell
        is_younger = local_files_of(names.get("__name__") or "") is None and os.stat(code.co_filename).st_mtime > _BEGAN
        if is_younger and code not in _codes(_source(code.co_filename, names), code.co_filename):
            why = "has changed since it was imported: import it again, or start a new session"
            raise SweepError(why, code.co_filename)
    return _functions(tree).get((code.co_firstlineno, code.co_name), ())


@lru_cache(maxsize=64)
def _codes(text: str, filename: str) -> frozenset[CodeType]:
    codes = [compile(text, filename, "exec", dont_inherit=True)]
    for code in codes:  # which grows meanwhile
        codes += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return frozenset(codes)


def classes_of(cls: type, tree: ast.Module | None) -> list[ast.ClassDef]:
    """Return the definitions of classes of a class's name."""
    nodes = ast.walk(tree) if tree is not None else ()
    return [node for node in nodes if isinstance(node, ast.ClassDef) and node.name == cls.__name__]


@lru_cache(maxsize=256)
def lines_of_names(tree: ast.Module | None) -> dict[str, int]:
    """Return the line in which each name of a module is bound first."""
    nodes = [] if tree is None else [node for statement in reversed(tree.body) for node in ast.walk(statement)]
    imported = {node.asname or node.name: node.lineno for node in nodes if isinstance(node, ast.alias)}
    stored = (node for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    return imported | {node.id: node.lineno for node in stored}


@lru_cache(maxsize=4096)
def parts_of(node: Function) -> tuple[str, list[ast.expr], Function]:
    """Return the text of a function without docstrings, its decorators, and what of it runs when it is called: neither
    defaults nor annotations, whose values count as they are.
    """
    made, decorators = copy.deepcopy(node), list(getattr(node, "decorator_list", ()))
    if not isinstance(made, ast.Lambda):
        made.decorator_list = []
    for inner in ast.walk(made):
        if (
            isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            and ast.get_docstring(inner) is not None
        ):
            inner.body = inner.body[1:] or [ast.Pass()]
    text = f"{ast.unparse(made)} {[ast.unparse(decorator) for decorator in decorators]}"
    made.args.defaults, made.args.kw_defaults = [], [None for _ in made.args.kwonlyargs]
    for inner in ast.walk(made.args):
        if isinstance(inner, ast.arg):
            inner.annotation = None
    if not isinstance(made, ast.Lambda):
        made.returns = None
    return text, decorators, made


@lru_cache(maxsize=4096)
def _global_names(text: str) -> frozenset[str]:
    tables, names = [symtable.symtable(text, "code", "exec")], set()
    for table in tables:  # which grows meanwhile
        names |= {one.get_name() for one in table.get_symbols() if one.is_referenced() and one.is_global()}
        tables += table.get_children()
    return frozenset(names)


def uses(nodes: Iterable[ast.AST], imported: Container[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Return the names in some code that its scope does not bind, or that it imports, each with the attributes that
    are taken of it.
    """
    todo, used = list(nodes), set()
    wanted = {name for node in todo for name in _global_names(ast.unparse(node))}
    while todo:
        node = todo.pop()
        name, path = chain(node)
        if name in wanted or name in imported:
            used.add((name, path))
        else:
            todo += ast.iter_child_nodes(node)
    return sorted(used)


def chain(node: ast.AST) -> tuple[str, tuple[str, ...]]:
    """Return the name and the attributes of an expression like ``a.b.c``, '' for any other."""
    path: list[str] = []
    while isinstance(node, ast.Attribute):
        path.insert(0, node.attr)
        node = node.value
    return (node.id, tuple(path)) if isinstance(node, ast.Name) else ("", ())


def effects(body: Iterable[ast.stmt], calls: bool) -> list[ast.stmt]:
    """Return the statements of a module that act on others: set attributes or items, or, with ``calls``, call."""
    acting = []
    for one in body:
        if isinstance(one, Function | ast.ClassDef) or (
            isinstance(one, ast.If) and "__name__" in ast.unparse(one.test)
        ):
            continue
        targets = getattr(one, "targets", [getattr(one, "target", None)])
        acts = any(isinstance(target, ast.Attribute | ast.Subscript) for target in targets)
        acts |= calls and isinstance(one, ast.Expr) and not isinstance(one.value, ast.Constant)
        inner = [s for handler in getattr(one, "handlers", ()) for s in handler.body]
        inner += [s for s in ast.iter_child_nodes(one) if isinstance(s, ast.stmt)]
        if acts or effects(inner, calls):
            acting.append(one)
    return acting


def changes(node: Function, label: str, names: Names, cells: Names, owner: type | None) -> set[Key]:
    """Return what a function changes while it runs: labels of names that it binds again, ids of objects, attributes of
    objects and of the class ``owner`` that it is a method of.
    """
    first = node.args.args[0].arg if owner is not None and node.args.args else None
    keys: set[Key] = set()

    def changed(expression: ast.AST, attribute: str = "") -> None:
        while isinstance(expression, ast.Subscript):
            expression = expression.value
        name, path = chain(expression)
        if name and name == first:
            if attribute := next(iter((*path, attribute)), ""):
                keys.update([(owner, attribute), (f"value {label_of(owner)}.{attribute}",)])
            return
        value = cells.get(name, names.get(name))
        for part in path:
            value = getattr(value, part, None)
        if value is None or type(value) in PLAIN:
            return
        keys.add((id(value), attribute) if attribute else (id(value),))
        if attribute and isinstance(value, FunctionType | type | ModuleType):
            module = isinstance(value, ModuleType)
            keys.add((f"value {without_package(value.__name__) if module else label_of(value)}.{attribute}",))

    for one in ast.walk(node):
        if isinstance(one, ast.Global):
            keys.update((f"value {without_package(names.get('__name__', ''))}.{name}",) for name in one.names)
        elif isinstance(one, ast.Nonlocal):
            keys.update((f"value {name} of {label}",) for name in one.names)
        elif isinstance(one, ast.Subscript) and not isinstance(one.ctx, ast.Load):
            changed(one.value)
        elif isinstance(one, ast.Attribute) and not isinstance(one.ctx, ast.Load):
            changed(one.value, one.attr)
        elif isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr in CHANGING:
            changed(one.func.value)
    return keys
