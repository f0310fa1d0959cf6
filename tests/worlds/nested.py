"""Nested results as flat mappings, so that numbers can be compared with a tolerance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def flat(value: Any) -> dict[str, Any]:
    """Every leaf of nested mappings and lists by its path; what is unknown (None) has none."""
    return dict(_leaves(value, ""))


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}")
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _leaves(inner, f"{path}[{k}]")
    elif value is not None:
        yield path, value
