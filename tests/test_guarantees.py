"""Every promise of docs/guarantees.md is tested, and by a test that runs without --all."""

import ast
import re

from tests.documents import ROOT

PAGE = (ROOT / "docs" / "guarantees.md").read_text()
PROMISES = re.findall(r"^\| ([^|]+) \|[^|]+\|([^|]+)\|$", PAGE, flags=re.MULTILINE)[1:]  # the first is the heading
NAMED = r"`(tests/[\w/]+\.py)`"


def is_slow(node):
    if isinstance(node, ast.FunctionDef):
        return "pytest.mark.slow" in map(ast.unparse, node.decorator_list)
    return any(re.match(r"pytestmark = .*pytest\.mark\.slow", ast.unparse(statement)) for statement in node.body)


def test_every_promise_names_a_quick_test():
    quick = {}  # whether a file has tests that run without --all, at least with some of their parameters
    for file in {file for _, tests in PROMISES for file in re.findall(NAMED, tests)}:
        module = ast.parse((ROOT / file).read_text())
        tests = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
        quick[file] = not is_slow(module) and not all(map(is_slow, tests))
    assert [promise for promise, tests in PROMISES if not any(map(quick.get, re.findall(NAMED, tests)))] == []
    assert len(PROMISES) > 25
