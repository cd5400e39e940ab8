"""Every promise of docs/guarantees.md is tested, and by a test that runs without --all."""

import ast
import re

from tests.documents import ROOT

PAGE = (ROOT / "docs" / "guarantees.md").read_text()
PROMISES = re.findall(r"^\| ([^|]+) \|[^|]+\|([^|]+)\|$", PAGE, flags=re.MULTILINE)[1:]  # the first is the heading
NAMED = r"`(tests/[\w/]+\.py)`"


def is_slow(node):
    """Whether a module's or a function's own statements mark all of it as slow."""
    if isinstance(node, ast.FunctionDef):
        return "pytest.mark.slow" in map(ast.unparse, node.decorator_list)
    return any(re.match(r"pytestmark = .*pytest\.mark\.slow", ast.unparse(statement)) for statement in node.body)


def has_quick_tests(file):
    """Whether a file has tests that run without --all, at least with some of their parameters."""
    module = ast.parse((ROOT / file).read_text())
    tests = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return not is_slow(module) and not all(map(is_slow, tests))


def test_every_promise_names_a_quick_test():
    untested = [p for p, tests in PROMISES if not any(map(has_quick_tests, re.findall(NAMED, tests)))]
    assert untested == []
    assert len(PROMISES) > 25


def test_every_test_that_the_page_names_exists():
    assert [file for file in re.findall(NAMED, PAGE) if not (ROOT / file).is_file()] == []
