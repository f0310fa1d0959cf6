"""The arithmetic of one round of elimination: what the blocks that go leave behind.

Of block j with the diagonal D_j = L_j L_j^T, the links E_j to its neighbours, the coupling B_j and the right-hand side a_j
remain, besides the fill-in at the neighbours, W_j = L_j^-1 and P_j = -D_j^-1 E_j for the back-substitution, and in the
store, in place of B_j and a_j, B_j W_j^T and W_j a_j: their products are what leaves the reduced system,

    C - sum_j B_j D_j^-1 B_j^T        b - sum_j B_j D_j^-1 a_j.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.windows import Batch

_WORTH_HALVING = 64
"""Width of a window from which half of the entries below the diagonal are not worked out."""


@dataclass(frozen=True)
class Lead:
    """What the elimination of a batch leaves to other blocks of its chains."""

    whiten: Float[Tensor, "e k k"]
    """W, the inverse Cholesky factors of the diagonals."""
    towards: Float[Tensor, "e k _"]
    """P, minus the inverse diagonals times the links to the neighbours."""
    square: Float[Tensor, "e _ _"]
    """To be added to the neighbours' diagonals and to the link between them."""


def lead_of(batch: Batch, diagonal: Float[Tensor, "p k k"], link: Float[Tensor, "p k k"]) -> Lead:
    """What a batch leaves behind of itself."""
    factor, failed = torch.linalg.cholesky_ex(diagonal[batch.place])
    # A block that is not positive definite spoils all that follows, and the whole step fails.
    inverse = torch.cholesky_inverse(factor).where((failed == 0)[:, None, None], torch.nan)
    links = link[batch.place]
    if batch.neighbour.shape[1] == 2:
        links = torch.cat((link[batch.neighbour[:, 0]].mT, links), dim=-1)
    towards = (inverse @ links).neg_()
    return Lead(factor.mT @ inverse, towards, links.mT @ towards)


def fill_chain(
    batch: Batch,
    square: Float[Tensor, "e _ _"],
    diagonal: Float[Tensor, "p k k"],
    link: Float[Tensor, "p k k"],
) -> None:
    """Adds the fill-in of the blocks that go to the diagonals and links of their neighbours, in place."""
    (e, sides), k = batch.neighbour.shape, diagonal.shape[-1]
    own = square.view(e, sides, k, sides, k).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    diagonal.view(-1, k * k).index_add_(0, batch.neighbour.flatten(), own.reshape(-1, k * k))
    if sides == 2:
        link[batch.neighbour[:, 0]] = square[:, :k, k:]


@dataclass(frozen=True)
class Eliminated:
    """What the elimination of a batch leaves to others."""

    lead: Lead
    at: Int[Tensor, " ww"]
    product: Float[Tensor, " ww"]
    """To be added to the reduced system, and where."""
    fill: Float[Tensor, "rows k"]
    """To be added to the neighbours' rows of the store."""


def eliminate(
    batch: Batch,
    diagonal: Float[Tensor, "p k k"],
    link: Float[Tensor, "p k k"],
    store: Float[Tensor, "rows k"],
    stride: int,
) -> Eliminated:
    """What a batch leaves behind, for a reduced system of `stride` columns; its rows of the store are whitened in place."""
    groups, size, w, _ = batch.fill.shape
    k = store.shape[-1]
    lead = lead_of(batch, diagonal, link)
    rows = rows_of(batch, store)
    # Adding rows as they are is several times faster than subtracting them: P carries the sign.
    fill = (rows @ lead.towards).view(-1, k)
    rows.copy_(rows @ lead.whiten.mT)
    wide = rows.view(groups, size, w, k).transpose(1, 2).reshape(groups, w, size * k)
    half = w // 2 if w >= _WORTH_HALVING else w
    ats, products = [], []
    for here, there in ((slice(half), slice(w)), (slice(half, w), slice(half, w))):
        if here.start == w:
            continue
        column = batch.columns[:, there]
        ats.append((batch.columns[:, here, None] * stride + column[:, None]).flatten())
        products.append((wide[:, here] @ wide[:, there].mT).neg_().flatten())
    return Eliminated(lead, torch.cat(ats), torch.cat(products), fill)


def rows_of(batch: Batch, store: Float[Tensor, "rows k"]) -> Float[Tensor, "e w k"]:
    """The batch's rows of the store."""
    groups, size, w, _ = batch.fill.shape
    rows = store[batch.first_row : batch.first_row + groups * size * w]
    return rows.view(groups * size, w, store.shape[-1])
