"""Every promise of docs/guarantees.md is tested, and by a test that runs without --all."""

import ast
import re

import pytest

from tests.documents import ROOT

PROMISES = {
    row[0].strip(): re.findall(r"`(tests/[\w/]+\.py)`", row[2])
    for row in (
        line.strip("|").split("|")
        for line in (ROOT / "docs" / "guarantees.md").read_text().splitlines()
        if line.count("|") == 4 and "---" not in line
    )
    if row[0].strip() != "promise"
}


def is_slow(node):
    """Whether a module's or a function's own statements mark all of it as slow."""
    if isinstance(node, ast.FunctionDef):
        return "pytest.mark.slow" in map(ast.unparse, node.decorator_list)
    marks = [ast.unparse(s.value) for s in node.body if isinstance(s, ast.Assign) and "pytestmark" in ast.unparse(s)]
    return any("pytest.mark.slow" in mark for mark in marks)


def quick_tests(file):
    """The tests of a file that run without --all, at least with some of their parameters."""
    module = ast.parse((ROOT / file).read_text())
    if is_slow(module):
        return []
    functions = [node for node in module.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return [function.name for function in functions if not is_slow(function)]


def test_the_page_has_its_promises():
    assert len(PROMISES) > 25


@pytest.mark.parametrize("promise", PROMISES)
def test_a_promise_names_a_quick_test(promise):
    files = PROMISES[promise]
    assert files, "no test is named"
    assert any(quick_tests(file) for file in files)


def test_every_test_that_the_page_names_exists():
    named = re.findall(r"`(tests/[\w/]+\.py)`", (ROOT / "docs" / "guarantees.md").read_text())
    assert [file for file in named if not (ROOT / file).is_file()] == []
