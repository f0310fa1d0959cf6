"""The arithmetic of one round of elimination: what the blocks that go leave behind.

Of block j with the diagonal D_j = L_j L_j^T, the links E_j to its neighbours, the coupling B_j and the right-hand side a_j
remain, besides the fill-in at the neighbours, W_j = L_j^-1 and V_j = -W_j E_j for the back-substitution; B_j and a_j stay in
the store. The products of B_j W_j^T and W_j a_j are what leaves the reduced system,

    C - sum_j B_j D_j^-1 B_j^T        b - sum_j B_j D_j^-1 a_j.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import sum_of_products
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix, TilePattern
from crowdmap_torch.optim.solvers.windows import Batch, Product, Round
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.sums import add_at, lasting
from crowdmap_torch.processes.threads import in_order


@dataclass(frozen=True)
class Lead:
    """What the elimination of a round leaves to other blocks of its chains, block by block, while the round lasts."""

    both: Float[Tensor, "e k _"]
    """W and V, one beside the other."""

    @property
    def whiten(self) -> Float[Tensor, "e k k"]:
        """W, the inverse Cholesky factors of the diagonals."""
        return self.both[..., : self.both.shape[1]]

    @property
    def towards(self) -> Float[Tensor, "e k _"]:
        """V, minus these times the links to the neighbours."""
        return self.both[..., self.both.shape[1] :]

    def square(self) -> Float[Tensor, "e _ _"]:
        """To be added to the neighbours' diagonals and to the link between them."""
        V = self.towards
        return torch.baddbmm(V.new_zeros(1, 1, 1), V.mT, V, beta=0, alpha=-1)

    def kept(self) -> KeptLead:
        """The same for later solves."""
        return KeptLead(self.both.permute(1, 2, 0).contiguous())


@dataclass(frozen=True)
class KeptLead:
    """What a round leaves behind for good, with the blocks as the last axis: solves take as long as reading it does."""

    both: Float[Tensor, "k _ e"]
    """W and V, one beside the other."""

    @property
    def whiten(self) -> Float[Tensor, "k k e"]:
        """W."""
        return self.both[:, : len(self.both)]

    @property
    def towards(self) -> Float[Tensor, "k _ e"]:
        """V."""
        return self.both[:, len(self.both) :]

    def blocks(self, some: slice) -> Lead:
        """The same of some blocks, block by block."""
        return Lead(self.both[..., some].permute(2, 0, 1).contiguous())


def lead_of(
    of_round: Round, diagonal: Float[Tensor, "p k k"], link: Float[Tensor, "p k k"]
) -> Lead:
    """What a round leaves behind of itself."""
    factor, failed = torch.linalg.cholesky_ex(diagonal[of_round.place])
    # A block that is not positive definite spoils all that follows, and the whole step fails.
    factor = factor.where((failed == 0)[:, None, None], torch.nan)
    k = factor.shape[-1]
    eye = torch.eye(k, dtype=factor.dtype, device=factor.device).neg_().expand_as(factor)
    links = [eye, link[of_round.place]]
    if of_round.neighbour.shape[1] == 2:
        links.insert(1, link[of_round.neighbour[:, 0]].mT)
    return Lead(torch.linalg.solve_triangular(factor, torch.cat(links, dim=-1), upper=False).neg_())


def fill_chain(
    of_round: Round,
    square: Float[Tensor, "e _ _"],
    diagonal: Float[Tensor, "p k k"],
    link: Float[Tensor, "p k k"],
) -> None:
    """Adds the fill-in of the blocks that go to the diagonals and links of their neighbours, in place."""
    neighbour, k = of_round.neighbour, diagonal.shape[-1]
    e, sides = neighbour.shape
    own = square.view(e, sides, k, sides, k).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    add_at(diagonal.view(-1, k * k), 0, neighbour.flatten(), own.reshape(-1, k * k))
    if sides == 2:
        link[neighbour[:, 0]] = square[:, :k, k:]


def leads_of(
    rounds: Sequence[Round], diagonal: Float[Tensor, "p k k"], link: Float[Tensor, "p k k"]
) -> tuple[KeptLead, ...]:
    """What all rounds leave behind of themselves; the blocks, by place, are changed."""
    leads = []
    for of_round in rounds:
        lead = lead_of(of_round, diagonal, link)
        fill_chain(of_round, lead.square(), diagonal, link)
        leads.append(lead.kept())
    return tuple(leads)


def solve_rounds(
    rounds: Sequence[Round], leads: Sequence[KeptLead], rest: Float[Tensor, "p k c"]
) -> Float[Tensor, "p k c"]:
    """A^-1 of right-hand sides by place, forth and back through rounds, the last ones of all.

    The places are counted from the first of these rounds on.
    """
    gone = rounds[0].place.start if rounds else 0
    left = [_left(of_round.neighbour, gone) for of_round in rounds]
    rest = rest.permute(1, 2, 0).contiguous()
    flat = rest.flatten(0, 1)
    for of_round, neighbour, lead in zip(rounds, left, leads, strict=True):
        for some, own in _by_lots(of_round, gone, rest):
            whitened = sum_of_products(lead.whiten[..., some].transpose(0, 1), rest[..., own])
            rest[..., own] = whitened
            fill = sum_of_products(lead.towards[..., some], whitened)
            for side, at in zip(fill.split(len(rest)), neighbour, strict=True):
                add_at(flat, 1, at[some], side.flatten(0, 1))
    # Back in the same memory: neighbours went later, and the last place is nobody's.
    rest[..., -1] = 0
    backwards = zip(reversed(rounds), reversed(left), reversed(leads), strict=True)
    for of_round, neighbour, lead in backwards:
        for some, own in _by_lots(of_round, gone, rest):
            here = (at[some].expand(len(flat), -1) for at in neighbour)
            beside = torch.cat([flat.gather(1, at).view(*rest.shape[:2], -1) for at in here])
            moved = sum_of_products(lead.towards[..., some].transpose(0, 1), beside)
            rest[..., own] = sum_of_products(lead.whiten[..., some], moved.add_(rest[..., own]))
    return rest.permute(2, 0, 1)


def _left(neighbour: Int[Tensor, "e s"], gone: int) -> Int[Tensor, "s e"]:
    """Places of neighbours by side, counted behind those that are `gone`."""
    return lasting(("left", gone), lambda: (neighbour.mT - gone).contiguous(), neighbour)


def _by_lots(
    of_round: Round, gone: int, rest: Float[Tensor, "k c p"]
) -> Iterator[tuple[slice, slice]]:
    """The blocks of a round and their places in `rest`, as many at once as suit the device."""
    first, count = of_round.place.start - gone, of_round.place.stop - of_round.place.start
    size = at_once(_LOT, rest.device, each=rest[..., :1].numel())
    for begin in range(0, count, size):
        end = min(begin + size, count)
        yield slice(begin, end), slice(first + begin, first + end)


@dataclass(frozen=True)
class Eliminated:
    """What the elimination of a batch leaves to others."""

    fill: Float[Tensor, "rows k"]
    """To be added to the neighbours' rows of the store."""
    wide: Float[Tensor, "b w gk"]
    """The whitened rows of every group's window."""
    scattered: tuple[Int[Tensor, " n"], Float[Tensor, " n"]] | None
    """Where in the reduced system what of their products is to be added; None: they are subtracted run by run."""


def eliminate(
    batch: Batch,
    whiten: Float[Tensor, "e k k"],
    towards: Float[Tensor, "e k _"],
    store: Float[Tensor, "rows k"],
    pattern: TilePattern,
) -> Eliminated:
    """What a batch leaves behind, by its part of the round's lead; `pattern` is that of the reduced system."""
    groups, size, w, _ = batch.fill.shape
    k = store.shape[-1]
    rows = rows_of(batch, store)
    whitened = rows @ whiten.mT
    # Adding rows as they are is several times faster than subtracting them: V carries the sign.
    fill = (whitened @ towards).view(-1, k)
    wide = whitened.view(groups, size, w, k).transpose(1, 2).reshape(groups, w, size * k)
    scattered = None
    if batch.products is None:
        product = (wide @ wide.mT).neg_()
        columns = batch.columns
        at = lasting("at", lambda: pattern.squares(columns).flatten(), columns, pattern.base)
        scattered = at, product.flatten()
    return Eliminated(fill, wide, scattered)


class Products:
    """Products that wait to be subtracted from the reduced system: by rows of tiles, each on one core, in order."""

    def __init__(self, system: TileMatrix) -> None:
        self.system = system
        self._tiles, self._right_side = system.tiles, system.right_side[None]
        self._waiting: dict[int, list[tuple[Product, Tensor]]] = {}
        self._held = 0

    def add(self, products: Iterable[tuple[int, Product]], wide: Float[Tensor, "b w gk"]) -> None:
        """Products of a batch's windows."""
        for row, product in products:
            self._waiting.setdefault(row, []).append((product, wide))
        self._held += wide.numel()
        if self._held > _HELD:
            self.subtract()

    def subtract(self) -> None:
        """Subtracts all that wait."""

        def of_row(waiting: list[tuple[Product, Tensor]]) -> None:
            for product, wide in waiting:
                of_group = wide[product.group]
                into = self._right_side if product.tile < 0 else self._tiles[product.tile]
                into[product.here].addmm_(
                    of_group[product.rows], of_group[product.beside].mT, alpha=-1
                )

        # The long rows first.
        rows = [self._waiting[row] for row in sorted(self._waiting)]
        for _ in in_order(of_row, rows, self._tiles.device):
            pass
        self._waiting, self._held = {}, 0


_HELD = 1 << 22
"""Numbers of windows that may wait."""
_LOT = 1 << 16
"""Numbers of right-hand sides that are solved for at once."""


def rows_of(batch: Batch, store: Float[Tensor, "rows k"]) -> Float[Tensor, "e w k"]:
    """The batch's rows of the store."""
    groups, size, w, _ = batch.fill.shape
    rows = store[batch.first_row : batch.first_row + groups * size * w]
    return rows.view(groups * size, w, store.shape[-1])
