from __future__ import annotations

import pytest
import torch

from crowdmap_torch.geometry.associative_scan import Elements, associative_scan


def chained(earlier: Elements, later: Elements) -> Elements:
    """Maps `x -> A x + b`, one behind the other: associative, and not commutative."""
    (A, b), (A_on, b_on) = earlier, later
    return A_on @ A, (A_on @ b[..., None])[..., 0] + b_on


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 16, 17, 100])
def test_every_place_holds_what_a_loop_makes_of_all_up_to_it(
    count: int, generator: torch.Generator
) -> None:
    A = torch.randn(count, 3, 3, dtype=torch.float64, generator=generator) / 2
    b = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    scanned = associative_scan(chained, (A, b))
    so_far: Elements | None = None
    for k in range(count):
        here = (A[k : k + 1], b[k : k + 1])
        so_far = here if so_far is None else chained(so_far, here)
        for ours, expected in zip(scanned, so_far, strict=True):
            torch.testing.assert_close(ours[k], expected[0], rtol=1e-12, atol=1e-12)


def test_calls_grow_with_the_logarithm_of_the_length() -> None:
    calls = []

    def added(earlier: Elements, later: Elements) -> Elements:
        calls.append(len(earlier[0]))
        return (earlier[0] + later[0],)

    ones = torch.ones(1000, dtype=torch.float64)
    torch.testing.assert_close(associative_scan(added, (ones,))[0], ones.cumsum(0))
    assert len(calls) <= 2 * 10 and sum(calls) < 2 * len(ones)
