"""Records of tensors, down to the last of these: dataclasses, mappings and tuples of them, one within the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor


def with_tensors(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """The same with every tensor changed; what has none that `change` makes another of is the same object."""
    if isinstance(value, Tensor):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        held = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        made = {name: with_tensors(x, change) for name, x in held.items()}
        changed = {name: x for name, x in made.items() if x is not held[name]}
        return replace(value, **changed) if changed else value
    if isinstance(value, Mapping):
        made = {key: with_tensors(x, change) for key, x in value.items()}
        return made if any(made[key] is not x for key, x in value.items()) else value
    if isinstance(value, tuple):
        items = tuple(with_tensors(x, change) for x in value)
        return items if any(a is not b for a, b in zip(items, value, strict=True)) else value
    return value


def alone(value: Any) -> Any:
    """The same with copies of tensors that are a part of larger memory: sent elsewhere, they would take all of it along."""

    def copied(tensor: Tensor) -> Tensor:
        own = tensor.numel() * tensor.element_size()
        return tensor.clone() if tensor.untyped_storage().nbytes() > own else tensor

    return with_tensors(value, copied)
