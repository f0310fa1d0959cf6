"""Frozen dataclasses of tensors as plain trees and back: what can be kept in a file without running code from it.

A tree is made of dictionaries with text keys, lists, tensors, numbers, truth values, text and None. Coming back, every part
is held against the annotation of its field: a tree of another class is a ValueError that names the field.
"""

from __future__ import annotations

import collections.abc
import hashlib
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any, TypeVar

import torch
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

T = TypeVar("T")


def to_tree(value: Any) -> Any:
    """The plain tree of a value; TypeError if it holds anything that a tree cannot.

    Tensors come as copies on the CPU, with the strides that they have: sums are taken in the order of memory.
    """
    if isinstance(value, Tensor):
        return _own_copy(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if is_dataclass(value):
        return {f.name: to_tree(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise TypeError("a mapping with keys that are not text cannot be kept")
        return {key: to_tree(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [to_tree(part) for part in value]
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def from_tree(kind: Any, tree: Any, *, where: str = "") -> Any:
    """The value of a tree, by its class or other annotation; ValueError names what is not of that kind."""
    if isinstance(kind, type) and issubclass(kind, AbstractArray):
        # Sizes with a name are those of nobody who calls this.
        with jaxtyped("context"):
            fits = isinstance(tree, kind)
        _require(fits, kind.__name__, tree, where)
        return tree
    if is_dataclass(kind):
        return _dataclass_of(kind, tree, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if tree is None and type(None) in arguments:
            return None
        return from_tree(next(a for a in arguments if a is not type(None)), tree, where=where)
    if origin in (dict, collections.abc.Mapping):
        _require(isinstance(tree, dict), "a mapping", tree, where)
        return {k: from_tree(arguments[1], v, where=f"{where}[{k!r}]") for k, v in tree.items()}
    if origin is tuple:
        _require(isinstance(tree, list), "a list", tree, where)
        endless = len(arguments) == 2 and arguments[1] is Ellipsis
        kinds = [arguments[0]] * len(tree) if endless else list(arguments)
        _require(len(kinds) == len(tree), f"{len(kinds)} values", tree, where)
        parts = enumerate(zip(kinds, tree, strict=True))
        return tuple(from_tree(k, part, where=f"{where}[{i}]") for i, (k, part) in parts)
    if kind not in (Tensor, bool, int, float, str):
        raise TypeError(f"{where}: a field annotated {kind} cannot be kept")
    fits = isinstance(tree, int | float if kind is float else kind)
    _require(fits and (kind is bool or not isinstance(tree, bool)), kind.__name__, tree, where)
    return tree


def digest(value: Any) -> str:
    """Hexadecimal digits that differ where values do, be it in a bit, a shape or a type."""
    found = hashlib.sha256()
    _feed(found, to_tree(value))
    return found.hexdigest()


@lru_cache(maxsize=256)
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _dataclass_of(kind: Any, tree: Any, where: str) -> Any:
    names = [f.name for f in fields(kind)]
    here = where or kind.__name__
    _require(isinstance(tree, dict), f"the fields of {kind.__name__}", tree, here)
    if set(tree) != set(names):
        raise ValueError(f"{here}: expected the fields {names}, found {sorted(map(str, tree))}")
    hints = _hints(kind)
    parts = {n: from_tree(hints[n], tree[n], where=f"{here}.{n}") for n in names}
    arrays = [(n, _array_kind(hints[n]), part) for n, part in parts.items()]
    # Sizes with a name are the same throughout a table.
    with jaxtyped("context"):
        for name, array, part in arrays:
            if array is not None and part is not None and not isinstance(part, array):
                raise ValueError(
                    f"{here}.{name}: expected {array.__name__} as long as its neighbours, "
                    f"found {_named(part)}"
                )
    return kind(**parts)


def _array_kind(hint: Any) -> Any:
    """The annotation of an array that may be missing; None if it is another one."""
    either = typing.get_origin(hint) in (typing.Union, types.UnionType)
    for kind in typing.get_args(hint) if either else (hint,):
        if isinstance(kind, type) and issubclass(kind, AbstractArray):
            return kind
    return None


def _require(fits: bool, expected: str, found: Any, where: str) -> None:
    if not fits:
        raise ValueError(f"{where}: expected {expected}, found {_named(found)}")


def _named(found: Any) -> str:
    if isinstance(found, Tensor):
        return f"a tensor {found.dtype} {list(found.shape)}"
    return f"a {type(found).__name__}"


def _own_copy(tensor: Tensor) -> Tensor:
    """A copy with the same strides, and a memory of no more than it spans."""
    tensor = tensor.detach().cpu()
    if not tensor.numel():
        return tensor.clone()
    span = 1 + sum((n - 1) * s for n, s in zip(tensor.shape, tensor.stride(), strict=True))
    flat = tensor.as_strided((span,), (1,)).clone()
    return flat.as_strided(tensor.shape, tensor.stride())


def _feed(found: Any, tree: Any) -> None:
    """Adds a tree to a hash, every part with its type and length before it."""
    if isinstance(tree, Tensor):
        found.update(f"tensor {tree.dtype} {list(tree.shape)};".encode())
        flat = tree.contiguous().view(-1)
        found.update(flat.view(torch.uint8).numpy() if len(flat) else b"")
    elif isinstance(tree, dict):
        found.update(f"dict {len(tree)};".encode())
        for key in sorted(tree):
            _feed(found, key)
            _feed(found, tree[key])
    elif isinstance(tree, list):
        found.update(f"list {len(tree)};".encode())
        for part in tree:
            _feed(found, part)
    else:
        text = repr(tree).encode()
        found.update(f"{type(tree).__name__} {len(text)};".encode() + text)
