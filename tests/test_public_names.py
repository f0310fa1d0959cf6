"""The names of the package itself: all there, each from its module, and nothing loaded before it is asked for."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import crowdmap_torch

ROOT = Path(__file__).parents[1]


def checked_by_types() -> dict[str, str]:
    """What type checkers are told: the module of each name."""
    tree = ast.parse(Path(crowdmap_torch.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.name: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_type_checkers_and_the_interpreter_are_told_the_same():
    homes = checked_by_types()
    assert sorted(homes) == sorted(crowdmap_torch.__all__)
    for name, module in homes.items():
        assert getattr(crowdmap_torch, name) is getattr(importlib.import_module(module), name)


def test_all_names_are_listed():
    assert set(crowdmap_torch.__all__) <= set(dir(crowdmap_torch))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'draw_map'"):
        crowdmap_torch.draw_map  # noqa: B018


def test_the_package_is_imported_without_what_it_stands_on():
    code = (
        "import sys, crowdmap_torch; "
        "print(sorted({'torch', 'numpy', 'pyarrow', 'sklearn', 'matplotlib'} & {*sys.modules}))"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert ended.stdout == "[]\n"
