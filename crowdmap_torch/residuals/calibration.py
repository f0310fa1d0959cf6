"""What a calibration adds to a residual: a linear part, beside whatever the term has already."""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm, Jacobian


def with_linear_part(
    term: CostTerm, name: str, block: Int[Tensor, " m"], by: Float[Tensor, "m d k"]
) -> CostTerm:
    """The term with `by` times another unknown added to its residual, the unknown's `block` a slot behind the others.

    The term's residual serves many rows at once.
    """
    slots = len(term.slots)

    def residual(*args: Tensor) -> Tensor:
        *others, J = args
        return term.residual(*others[:slots], *others[slots + 1 :]) + (J * others[slots]).sum(1)

    def jacobian(*args: Tensor) -> tuple[Tensor, tuple[Jacobian, ...]]:
        *others, J = args
        assert term.jacobian is not None
        value, by_slot = term.jacobian(*others[:slots], *others[slots + 1 :])
        return value + (J * others[slots]).sum(1), (*by_slot[:slots], J)

    return replace(
        term,
        residual=residual,
        slots=(*term.slots, (name, block)),
        constants=(*term.constants, by),
        jacobian=None if term.jacobian is None else jacobian,
    )
