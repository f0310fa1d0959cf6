"""Sums by index, `total[index] += value`: on a CPU one after the other, on a GPU in sorted order.

Atomic additions come in any order on a GPU, and the last bits with them. torch's own deterministic way (`repeatable`) sorts
the rows at every call, and takes milliseconds for a million of them. Here the rows of an index that lasts are sorted once,
and added up in lots, a thread for each, lots of lots, and so on. Few rows are left to torch, whose calls are fewer.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

_LOT = 64
"""Rows that one thread adds up."""
_MANY = 1 << 17
"""Numbers from which sorting pays."""

T = TypeVar("T")


class _Sorted(NamedTuple):
    """Rows in the order of their indices."""

    order: Int[Tensor, " n"]
    lots: tuple[Int[Tensor, " _"], ...]
    """Where the lots of rows begin, the lots of these, and so on, until there is one for each index; behind them the end."""
    of_lot: Int[Tensor, " i"]
    """The index of each of the last ones."""


def add_at(
    total: Float[Tensor, ...],
    dim: int,
    index: Int[Tensor, " n"],
    value: Float[Tensor, ...],
    *,
    alpha: float = 1.0,
) -> Float[Tensor, ...]:
    """As `total.index_add_(dim, index, value, alpha=alpha)`, in place, with the same bits every time on a GPU too."""
    if not value.is_floating_point():
        # Whole numbers have one sum in any order; by a factor that is none torch multiplies them into floats on a GPU.
        return total.index_add_(dim, index, value, alpha=int(alpha))
    if not _sorts(total.device) or value.numel() < _MANY:
        return total.index_add_(dim, index, value, alpha=alpha)
    by_index, at = _sorted(index), dim % value.ndim
    outer, inner = value.shape[:at], value.shape[at + 1 :]
    rows = value.reshape(outer.numel(), len(index), inner.numel())
    rows = rows.index_select(1, by_index.order)
    for begins in by_index.lots:
        offsets = begins.expand(len(rows), -1).contiguous()
        rows = torch.segment_reduce(rows, "sum", offsets=offsets, axis=1, unsafe=True)
    rows = rows.view(*outer, len(by_index.of_lot), *inner)
    with _in_any_order():
        # Every index is there once.
        return total.index_add_(dim, by_index.of_lot, rows, alpha=alpha)


def running_sum(value: Float[Tensor, "n ..."]) -> Float[Tensor, "n ..."]:
    """As `value.cumsum(0)`, with the same bits every time on a GPU too: there by sums of twice as many rows each time."""
    if not _sorts(value.device):
        return value.cumsum(0)
    rows = 1
    while rows < len(value):
        value = torch.cat((value[:rows], value[rows:] + value[:-rows]))
        rows *= 2
    return value


def _sorts(device: torch.device) -> bool:
    return device.type != "cpu"


_kept: dict[int, tuple[weakref.ref[Tensor], dict[Hashable, Any]]] = {}
"""By the tensor that an index is a view of, as long as it is there: what is known of its views."""


def lasting(name: Hashable, make: Callable[[], T], first: Tensor, *others: Tensor) -> T:
    """What `make` derives, under this `name`, of indices that last, and of nothing else that changes.

    On a GPU it is made once and known again as long as they are there and are not written to, so that sums by it are sorted
    once; on a CPU, where nothing is sorted, every time. It goes with the `first`, which is to be that of the shortest life.
    """
    if not _sorts(first.device):
        return make()
    known, view = _of(first)
    key = name, view, *((id(_owner(x)), _of(x)[1]) for x in others)
    found = known.get(key)
    if found is None or any(
        one() is not _owner(x) for one, x in zip(found[0], others, strict=True)
    ):
        found = known[key] = tuple(weakref.ref(_owner(x)) for x in others), make()
    return found[1]


def _sorted(index: Int[Tensor, " n"]) -> _Sorted:
    """Sorted at first, known again as long as the tensor that it is a view of is there and is not written to."""
    known, view = _of(index)
    by_index = known.get(view)
    if by_index is None:
        by_index = known[view] = _sort(index)
    return by_index


def _of(index: Tensor) -> tuple[dict[Hashable, Any], Hashable]:
    """What is known of views of the tensor that an index is one of, and which of them it is."""
    owner = _owner(index)
    number = id(owner)
    found = _kept.get(number)
    if found is None or found[0]() is not owner:
        # The table is named here: at the end of a program modules go before tensors.
        found = weakref.ref(owner, lambda _, kept=_kept: kept.pop(number, None)), {}
        _kept[number] = found
    return found[1], (index.storage_offset(), index.shape, index.stride(), owner._version)


def _owner(index: Tensor) -> Tensor:
    return index if index._base is None else index._base


def _sort(index: Int[Tensor, " n"]) -> _Sorted:
    of_lot, order = index.sort(stable=True)
    levels: list[Tensor] = []
    while True:
        begins = torch.ones_like(of_lot, dtype=torch.bool)
        begins[1:] = of_lot[1:] != of_lot[:-1]
        first = torch.nonzero(begins)[:, 0]
        if levels and len(first) == len(of_lot):
            return _Sorted(order, tuple(levels), of_lot)
        place = torch.arange(len(of_lot), device=index.device) - first[begins.cumsum(0) - 1]
        lots = torch.nonzero(place % _LOT == 0)[:, 0]
        levels.append(torch.cat((lots, lots.new_full((1,), len(of_lot)))))
        of_lot = of_lot[lots]


@contextmanager
def _in_any_order() -> Iterator[None]:
    """Within it torch need not see to it that sums come in one order."""
    if not torch.are_deterministic_algorithms_enabled():
        yield
        return
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.use_deterministic_algorithms(False)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(True, warn_only=warn_only)
