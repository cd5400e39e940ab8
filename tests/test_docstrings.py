"""The examples in docstrings run and print what they show."""

import doctest
from importlib import import_module

import pytest

from tests.documents import ROOT

MODULES = [
    ".".join(("linksweep", *path.relative_to(ROOT / folder).with_suffix("").parts)).removesuffix(".__init__")
    for folder, top in (("linksweep", "linksweep"), ("", "core"), ("", "sweep"))
    for path in sorted((ROOT / top).rglob("*.py"))
    if ">>> " in path.read_text()
]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert results.attempted
    assert not results.failed
