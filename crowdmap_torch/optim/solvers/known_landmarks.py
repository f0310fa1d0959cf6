"""What is uncertain of eliminated blocks where landmarks and border are known: of A^-1 what is asked for.

Where drives are cut, the joints are landmarks by their place alone: what they add counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import KeptLead
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.joints import Joints, joints_of
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.selected_inverse import diagonal_of_inverse
from crowdmap_torch.optim.solvers.staying_blocks import StayingBlocks
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.threads import in_order

_AT_ONCE = 1 << 13
"""Leaves whose blocks are computed together on a CPU."""


@dataclass(frozen=True)
class KnownLandmarks:
    """The covariances of chains and leaves, undamped, landmarks and border known; letters as in `chain_schur`."""

    structure: ChainStructure
    diagonal: Float[Tensor, "e k k"] = field(repr=False)
    link: Float[Tensor, "e k k"] = field(repr=False)
    leads: tuple[tuple[KeptLead, ...], ...] = field(repr=False)
    """What the elimination of A alone leaves behind, by part and round."""
    joints: Joints | None = field(repr=False)

    @classmethod
    def of(
        cls,
        structure: ChainStructure,
        diagonal: Float[Tensor, "e k k"],
        link: Float[Tensor, "e k k"],
        coupling: Mapping[str, Float[Tensor, "f w _"]],
        hessian: StayingBlocks,
        leads: tuple[tuple[KeptLead, ...], ...] | None = None,
    ) -> KnownLandmarks:
        """That of normal equations; `leads` where they are known already."""

        def led(part: Part) -> tuple[KeptLead, ...]:
            return part.leads(diagonal, link)

        if leads is None:
            leads = tuple(in_order(led, structure.parts, diagonal.device, worth=1))
        joints = joints_of(structure, coupling, hessian, leads)
        return cls(structure, diagonal, link, leads, joints)

    def of_blocks(self) -> Float[Tensor, "e k k"]:
        """Covariance of every eliminated block."""

        def of_part(of: tuple[Part, Sequence[KeptLead]]) -> Float[Tensor, "n k k"]:
            part, leads = of
            own = diagonal_of_inverse(part, leads)
            return own if self.joints is None else own + self.joints.of_blocks(part.block)

        found = torch.empty_like(self.diagonal)
        parts = self.structure.parts
        done = in_order(of_part, list(zip(parts, self.leads, strict=True)), found.device, worth=1)
        for part, own in zip(parts, done, strict=True):
            found[part.block] = own
        return found

    @cached_property
    def _of_chains(self) -> Float[Tensor, "n k k"]:
        """The same of the chains' blocks, but for what joints add."""

        def of_part(of: tuple[Part, Sequence[KeptLead]]) -> Float[Tensor, "m k k"]:
            return diagonal_of_inverse(*of, leaves=False)

        leaves, parts = self.structure.plan.leaf_count, self.structure.parts
        found = torch.empty_like(self.diagonal[leaves:])
        every = list(zip(parts, self.leads, strict=True))
        for part, own in zip(parts, in_order(of_part, every, found.device, worth=1), strict=True):
            found[part.block[part.leaf_count :] - leaves] = own
        return found

    def of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it."""
        plan = self.structure.plan
        assert plan.carrier is not None and plan.leaves is not None
        of_chain, carrier, joints = self._of_chains, plan.carrier, self.joints
        width = self.structure.width[plan.leaves]

        def of_some(at: slice) -> Float[Tensor, "m k"]:
            alone = torch.linalg.inv(self.diagonal[at])
            # The leaf goes with its carrier by -H^-1 times their link.
            lags = alone @ self.link[at]
            lags.diagonal(dim1=-2, dim2=-1).add_(1)
            carried, by = torch.unique(carrier[at], return_inverse=True)
            of_carrier = of_chain[carried]
            if joints is not None:
                of_carrier = of_carrier + joints.of_blocks(carried + plan.leaf_count)
            left = alone + lags @ of_carrier[by] @ lags.mT
            return left.diagonal(dim1=-2, dim2=-1)[:, :width]

        lot = at_once(_AT_ONCE, of_chain.device)
        bounds = [*range(0, max(plan.leaf_count, 1), lot), plan.leaf_count]
        some = [slice(a, b) for a, b in pairwise(bounds)]
        return torch.cat(list(in_order(of_some, some, of_chain.device)))
