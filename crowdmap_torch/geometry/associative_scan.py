"""All beginnings of a sequence put together, in a number of rounds that grows with the logarithm of its length."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Elements = tuple[Tensor, ...]
"""A sequence: tensors of one first axis, which together are an element in each place of it."""


def associative_scan(
    combine: Callable[[Elements, Elements], Elements],
    of: Elements,
    *,
    onto: Callable[[Elements, Elements], Elements] | None = None,
) -> Elements:
    """In each place the combination of the elements up to it, itself included.

    `combine` takes two sequences of the same length and combines them place by place, the earlier element first; it must be
    associative. Pairs are combined, the scan of the pairs gives every second place, and one combination more the
    others: about twice as many combinations as elements, in `2 log2` calls (Blelloch 1990). Half of them have a beginning
    for the earlier element: where of beginnings only the first tensors matter, `onto` may give just these.
    """
    onto = onto or combine
    count = len(of[0])
    if count < 2:
        return of
    even, odd = (tuple(t[k::2] for t in of) for k in (0, 1))
    pairs = associative_scan(combine, combine(_first(even, count // 2), odd), onto=onto)
    between = (count - 1) // 2
    rest = onto(_first(pairs, between), tuple(t[1:] for t in even)) if between else pairs
    scanned = []
    for element, second, other in zip(of, pairs, rest, strict=False):
        places = torch.empty_like(element)
        places[0] = element[0]
        places[1::2] = second
        if between:
            places[2::2] = other
        scanned.append(places)
    return tuple(scanned)


def _first(of: Elements, count: int) -> Elements:
    return tuple(t[:count] for t in of)
