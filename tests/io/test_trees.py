"""Dataclasses of tensors as plain trees, and what comes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from jaxtyping import Float, Int, jaxtyped
from torch import Tensor

from crowdmap_torch.io.trees import digest, from_tree, to_tree


@dataclass(frozen=True)
class Part:
    name: str
    at: Float[Tensor, "n 2"]
    row: Int[Tensor, " n"] | None = None


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]
    pair: tuple[int, float]
    by_name: Mapping[str, Float[Tensor, " _"]]
    is_good: bool


@pytest.fixture
def whole(generator: torch.Generator) -> Whole:
    at = torch.randn(4, 2, dtype=torch.float64, generator=generator)
    parts = (Part("a", at, torch.arange(4)), Part("b", at[1:]))
    return Whole(parts, (3, float("nan")), {"x": at[:, 0], "none": at[:0, 0]}, True)


def test_what_comes_back_is_the_same_to_the_bit(whole: Whole):
    assert digest(from_tree(Whole, to_tree(whole))) == digest(whole)


@pytest.mark.parametrize(
    "tensor",
    [
        torch.arange(6.0).view(2, 3).mT,
        torch.arange(24.0).view(2, 3, 4).permute(2, 0, 1),
        torch.arange(3.0).expand(5, 3),
        torch.arange(100.0)[10:60:7],
        torch.tensor(2.5),
        torch.zeros(0, 3),
    ],
)
def test_tensors_keep_their_strides_and_no_more_memory_than_they_span(tensor: Tensor):
    kept = to_tree(tensor)
    assert torch.equal(kept, tensor) and kept.stride() == tensor.stride()
    assert kept.untyped_storage().nbytes() <= tensor.untyped_storage().nbytes()
    assert kept.data_ptr() != tensor.data_ptr() or not tensor.numel()


def test_a_row_of_a_large_table_is_kept_alone():
    assert to_tree(torch.zeros(1000, 3)[7]).untyped_storage().nbytes() == 12


def change(tree: Any, path: tuple, value: Any) -> Any:
    """The tree with another value at a path."""
    if not path:
        return value
    copy = dict(tree) if isinstance(tree, dict) else list(tree)
    copy[path[0]] = change(copy[path[0]], path[1:], value)
    return copy


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("pair",), [1, 2.0, 3], r"Whole.pair: expected 2 values, found a list"),
        (("pair", 0), 1.5, r"Whole.pair\[0\]: expected int, found a float"),
        (("pair", 0), True, r"Whole.pair\[0\]: expected int, found a bool"),
        (("is_good",), 1, "Whole.is_good: expected bool, found a int"),
        (("parts", 1, "name"), None, r"Whole.parts\[1\].name: expected str, found a NoneType"),
        (("parts", 1, "at"), torch.zeros(3, 3), r"Whole.parts\[1\].at: expected Float"),
        (("parts", 0, "at"), torch.zeros(4, 2, dtype=torch.long), "Float.* found a tensor"),
        (("parts", 0, "row"), torch.arange(5), r"parts\[0\].row: .* as long as its"),
        (("parts", 0, "row"), [1, 2], r"Whole.parts\[0\].row: expected Int.*, found a list"),
        (("by_name",), [], "Whole.by_name: expected a mapping, found a list"),
        (("parts", 0), {"name": "a"}, r"expected the fields \['name', 'at', 'row'\], found"),
        (("parts",), {}, "Whole.parts: expected a list, found a dict"),
        ((), None, "Whole: expected the fields of Whole, found a NoneType"),
    ],
)
def test_a_tree_of_something_else_is_refused_by_name(
    whole: Whole, path: tuple, value: Any, said: str
):
    with pytest.raises(ValueError, match=said):
        from_tree(Whole, change(to_tree(whole), path, value))


def test_sizes_are_those_of_the_tree_alone(whole: Whole):
    rows: Any = Float[Tensor, "n 2"]
    with jaxtyped("context"):
        # Rows of who asks are called `n` as well.
        assert isinstance(torch.zeros(17, 2), rows)
        assert digest(from_tree(Whole, to_tree(whole))) == digest(whole)


def test_what_is_no_tree_is_not_kept():
    for value in (object(), {1: 2}, [len], {3}):
        with pytest.raises(TypeError, match="cannot be kept"):
            to_tree(value)


def test_a_digest_changes_with_bits_shapes_types_and_names(whole: Whole):
    first, second = whole.parts
    bit = first.at.clone()
    bit.view(torch.long)[2, 1] ^= 1
    assert first.row is not None
    others = [
        replace(whole, parts=(replace(first, at=bit), second)),
        replace(whole, parts=(replace(first, row=first.row.int()), second)),
        replace(whole, parts=(replace(first, row=None), second)),
        replace(whole, parts=(second, first)),
        replace(whole, is_good=False),
        replace(whole, by_name={"y": whole.by_name["x"], "none": whole.by_name["none"]}),
    ]
    assert len({digest(value) for value in (whole, *others)}) == len(others) + 1
    assert digest(torch.zeros(2, 3)) != digest(torch.zeros(3, 2))
    assert digest(["ab", "c"]) != digest(["a", "bc"])
    assert digest(1) != digest(True) != digest("1")
    # However it lies in memory.
    assert digest(torch.arange(6.0).view(2, 3).mT) == digest(
        torch.arange(6.0).view(2, 3).mT.contiguous()
    )
