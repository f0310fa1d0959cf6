"""The memory that solves of one back end share, and the factors that the last of them left there (`chain_schur`)."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import KeptLead
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix, TilePattern
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky


@dataclass
class Workspace:
    """What the solves of one back end share."""

    reduced: TilePattern = field(repr=False)
    """That of the reduced system."""
    is_kept: bool
    """Whether memory for the reduced system is taken once; of a part of a sum others need it meanwhile."""
    like: Float[Tensor, "0 k"] = field(repr=False)
    """Nothing, as wide as eliminated blocks, with the device and the type of all."""
    couplings: dict[str, Float[Tensor, "f w _"]] = field(default_factory=dict)
    """Of the last normal equations, by term."""
    factor: Factor | None = None
    """Of the last solve."""
    _kept: TileMatrix | None = field(default=None, repr=False)

    @classmethod
    def of(cls, structure: ChainStructure, like: Float[Tensor, "0 k"]) -> Workspace:
        """That of an order of elimination, whatever rows are to be eliminated by it."""
        return cls(structure.reduced, structure.plan.is_whole, like)

    def system(self) -> TileMatrix:
        """Zeros for the reduced system."""
        if self._kept is not None:
            self._kept.flat.zero_()
            return self._kept
        found = TileMatrix.zeros(self.reduced, self.like)
        if self.is_kept:
            self._kept = found
        return found

    def store(self, rows: int) -> Float[Tensor, "rows k"]:
        """Memory to eliminate in, whatever is in it: whoever does lets it go, others need it between two solves.

        Per eliminated block of a part and column of its window it has a row of `k`, by when it is eliminated.
        """
        return self.like.new_empty(rows, self.like.shape[1])

    def coupling(self, name: str, shape: tuple[int, ...]) -> Float[Tensor, "f w _"]:
        """Memory for a term's coupling; what is in it is of no account."""
        if name not in self.couplings or self.couplings[name].shape != shape:
            self.couplings[name] = self.like.new_empty(shape)
        return self.couplings[name]


@dataclass(frozen=True)
class Factor:
    """The factorised matrix."""

    leads: tuple[tuple[KeptLead, ...], ...]
    """By part and round."""
    reduced: TiledCholesky | None
    """Of S; None where S is a part of a sum."""
    of: Float[Tensor, "e k"]
    """The gradient a of the equations that they are of."""
    is_undamped: bool
    """Whether next to nothing was added to the diagonals."""
    added: Float[Tensor, " r"]
    """What was added to that of C."""
