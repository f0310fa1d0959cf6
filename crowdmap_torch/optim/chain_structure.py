"""The order in which chains of blocks are eliminated: odd-even reduction, worked out once per problem.

Blocks of the eliminated variable form chains (the frames of a journey). Each may carry leaves, blocks of a second
variable that are bound to it alone (the frame's own pose, where the chain is its slow drift): leaves go first. Then
every other block of each chain is eliminated, all chains at once; those between are the chain of the next level, half as
long, until no block is left (cyclic or nested reduction; Golub and Van Loan, Matrix Computations, 4.5.4).

What an eliminated block leaves behind lies in the columns of the landmarks that it sees, its window. Blocks that see
the same stretch of road, driven by anybody, form a group with one window, so that their products are one matrix product.
Groups of the same width are computed together, in batches of bounded size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from crowdmap_torch.optim.linear import Layout, layout
from crowdmap_torch.optim.problem import CostTerm, Problem, Values


@dataclass(frozen=True)
class Coupling:
    """A term between the eliminated blocks and the landmarks, its rows sorted by (block, landmarks)."""

    order: Int[Tensor, " m"] | None
    """Rows of the term, in the order of their factors; None where they are in that order already."""
    factor_of_row: Int[Tensor, " m"] | None
    """Rows of one eliminated block and the same landmarks add up to one factor; None: every row is its own."""
    block: Int[Tensor, " f"]
    """Eliminated block of each factor, counted over leaves and chain."""
    column: Int[Tensor, "f w"]
    """Columns of the reduced system that the factor touches."""
    landmark: Int[Tensor, "f q"]
    """The same as landmark blocks."""
    slot: int
    """Slot of the eliminated block."""


@dataclass(frozen=True)
class Batch:
    """Groups of equal width whose blocks are eliminated together; `b` groups of `g` places."""

    place: slice
    """Places of the order of elimination, group by group."""
    neighbour: Int[Tensor, "e s"]
    """Places of the blocks that each is linked to: before and behind it in the chain, or a leaf's carrier; the
    last place of all for none."""
    columns: Int[Tensor, "b w"]
    """The windows: columns of the reduced system; first its gradient, `dim`, and `dim + 1` for padding."""
    fill: Int[Tensor, "b g w s"]
    """Row of the boundary store that each entry's fill-in goes to, for every neighbour of the block."""
    first_row: int
    """Where the batch's rows begin in the boundary store."""


@dataclass(frozen=True)
class Level:
    """One round of elimination."""

    batches: tuple[Batch, ...]


@dataclass(frozen=True)
class ChainStructure:
    """Everything about the elimination that does not depend on values."""

    where: Layout
    """The reduced system: all variables but the eliminated ones."""
    couplings: dict[str, Coupling]
    factor_rows: dict[str, Int[Tensor, " fw"]]
    """Row of the boundary store of every column of a coupling's factors."""
    order: Int[Tensor, " places"]
    """Block at every place of the order of elimination; the number of blocks where a group has fewer, and last."""
    place: Int[Tensor, " n"]
    """Place of every block."""
    gradient_row: Int[Tensor, " n"]
    """Row of the boundary store of every block's gradient."""
    store_rows: int
    """Rows of the boundary store; one more takes what is to be forgotten."""
    chain_terms: tuple[str, ...]
    """Terms among the eliminated blocks alone."""
    landmark_terms: tuple[str, ...]
    levels: tuple[Level, ...]
    base: dict[str, int]
    """First block of the leaves and of the chain, counted over both."""
    chain: Int[Tensor, " n"]
    """Chain of each block, counted over both; -1 for leaves."""
    carrier: Int[Tensor, " m"]
    """Block of the chain that carries each leaf."""


def analyse(
    problem: Problem,
    values: Values,
    eliminate: str,
    chain: Int[Tensor, " n"],
    *,
    leaves: str | None = None,
    carrier: Int[Tensor, " m"] | None = None,
    group_size: int | None,
    batch_bytes: int,
) -> ChainStructure:
    """The elimination of `eliminate`, whose blocks lie chain by chain, in order, and of the `leaves` on them.

    Every row may touch one eliminated block and any landmarks, or one or two eliminated blocks: neighbours of a
    chain, or a leaf and the block that carries it.
    """
    leaf_count = 0 if carrier is None else len(carrier)
    base = {eliminate: 0} if leaves is None else {leaves: 0, eliminate: leaf_count}
    where = layout(problem, values, skip=tuple(base))
    landmarks = _landmarks(where, chain.device)
    couplings, chain_terms, landmark_terms = {}, [], []
    for name, term in problem.terms.items():
        eliminated = [i for i, (slot, _) in enumerate(term.slots) if slot in base]
        if len(eliminated) == len(term.slots):
            chain_terms.append(name)
        elif not eliminated:
            landmark_terms.append(name)
        elif len(eliminated) == 1:
            couplings[name] = _coupling(term, eliminated[0], landmarks, base)
        else:
            raise ValueError(
                f"term {name!r} couples {len(eliminated)} eliminated blocks with other variables; "
                "at most one is supported"
            )
    carrier = chain[:0] if carrier is None else carrier
    chain = torch.cat((torch.full_like(carrier, -1), chain))
    k = problem.variables[eliminate].tangent_dim
    chain_count = len(torch.unique(chain[chain >= 0]))
    # About as many as there are drives: those that see one stretch of road at the same step.
    size = group_size or min(64, max(4, chain_count))
    seen = _seen(couplings, landmarks)
    builder = _Builder(landmarks, _rank(seen, landmarks), len(chain), size, k, batch_bytes)
    rounds = [
        builder.windows(node, neighbour, keys)
        for node, neighbour, keys in _rounds(seen, chain, carrier, landmarks.count)
    ]
    places = [table.flatten() for _, _, batches in rounds for table, _ in batches]
    order = torch.cat((*places, chain.new_full((1,), len(chain))))
    place = torch.full((len(chain) + 1,), len(order) - 1, device=chain.device)
    place[order] = torch.arange(len(order), device=chain.device)
    place[-1] = len(order) - 1
    levels = tuple(builder.level(*windows, place) for windows in rounds)
    factor_rows = {name: builder.rows(c.block, c.landmark) for name, c in couplings.items()}
    return ChainStructure(
        where,
        couplings,
        factor_rows,
        order,
        place[:-1],
        builder.first_row[:-1],
        builder.store_rows,
        tuple(chain_terms),
        tuple(landmark_terms),
        levels,
        base,
        chain,
        carrier,
    )


@dataclass(frozen=True)
class _Landmarks:
    """The blocks of the variables that stay."""

    first: dict[str, int]
    """Number of each variable's first block."""
    column: Tensor
    """First column of every block."""
    width: Tensor
    dim: int

    @property
    def count(self) -> int:
        """At least one, so that keys can be taken apart."""
        return max(len(self.column), 1)


def _landmarks(where: Layout, device: torch.device) -> _Landmarks:
    first, columns, widths, total = {}, [], [], 0
    for name, offset in where.offset.items():
        first[name] = total
        total += len(offset)
        columns.append(offset)
        widths.append(torch.full_like(offset, where.tangent_dim[name]))
    none = torch.zeros(0, dtype=torch.long, device=device)
    return _Landmarks(first, torch.cat([none, *columns]), torch.cat([none, *widths]), where.dim)


def _coupling(term: CostTerm, slot: int, landmarks: _Landmarks, base: dict[str, int]) -> Coupling:
    name, block = term.slots[slot]
    block = block + base[name]
    others = [
        index + landmarks.first[other] for i, (other, index) in enumerate(term.slots) if i != slot
    ]
    # One number for the landmarks of a row: mixed radix, hashed down before it can overflow.
    key = block
    for at, index in enumerate(others):
        if at:
            _, key = torch.unique(key, return_inverse=True)
        key = key * landmarks.count + index
    order = None
    if not bool((key[1:] >= key[:-1]).all()):
        order = torch.argsort(key, stable=True)
        key = key[order]
    begins = torch.ones_like(key, dtype=torch.bool)
    begins[1:] = key[1:] != key[:-1]
    factor_of_row = None if bool(begins.all()) else begins.cumsum(0) - 1
    first = torch.nonzero(begins)[:, 0]
    first = first if order is None else order[first]
    landmark = torch.stack([index[first] for index in others], dim=-1)
    column = torch.cat(
        [
            landmarks.column[index[first]][:, None]
            + torch.arange(_width(landmarks, other), device=block.device)
            for (other, _), index in zip(
                (s for i, s in enumerate(term.slots) if i != slot), others, strict=True
            )
        ],
        dim=-1,
    )
    return Coupling(order, factor_of_row, block[first], column, landmark, slot)


def _width(landmarks: _Landmarks, name: str) -> int:
    first = landmarks.first[name]
    return int(landmarks.width[first]) if first < len(landmarks.width) else 0


def _seen(couplings: dict[str, Coupling], landmarks: _Landmarks) -> Int[Tensor, " keys"]:
    """Which block sees which landmark: keys `block * count + landmark`, sorted and unique."""
    keys = [(c.block[:, None] * landmarks.count + c.landmark).flatten() for c in couplings.values()]
    none = torch.zeros(0, dtype=torch.long, device=landmarks.column.device)
    return torch.unique(torch.cat([none, *keys]))


def _rank(keys: Tensor, landmarks: _Landmarks) -> Tensor:
    """A position of every landmark on a line, such that landmarks seen together are near each other."""
    count = landmarks.count
    # Blocks of a chain see nearly what their neighbours see: a few of them together tell the same.
    row, column = (keys // count // 8).cpu().numpy(), (keys % count).cpu().numpy()
    rows = int(row.max()) + 1 if len(row) else 1
    seen = coo_matrix((torch.ones(len(row)).numpy(), (row, column)), shape=(rows, count)).tocsr()
    order = reverse_cuthill_mckee((seen.T @ seen).tocsr(), symmetric_mode=True)
    rank = torch.empty(count, dtype=torch.double)
    rank[torch.from_numpy(order.astype("int64"))] = torch.arange(count, dtype=torch.double)
    return rank.to(keys.device)


def _rounds(
    keys: Tensor, chain: Tensor, carrier: Tensor, count: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Per round the blocks that go, their neighbours, and what they see by then, as keys."""
    n, leaves = len(chain), len(carrier)
    index = torch.arange(n, device=chain.device)
    if leaves:
        neighbour = (carrier + leaves)[:, None]
        yield index[:leaves], neighbour, keys[keys < leaves * count]
        keys = _passed_on(keys, index[:leaves], neighbour, n, count)
    node = index[leaves:]
    while len(node):
        of = chain[node]
        first = torch.ones_like(of, dtype=torch.bool)
        first[1:] = of[1:] != of[:-1]
        at = torch.arange(len(node), device=node.device)
        goes = (at - at[first][first.cumsum(0) - 1]) % 2 == 0
        last = torch.cat((first[1:], first.new_ones(1)))
        before = torch.where(first, n, torch.cat((node[:1], node[:-1])))
        behind = torch.where(last, n, torch.cat((node[1:], node[-1:])))
        neighbour = torch.stack((before, behind), dim=-1)[goes]
        gone = torch.zeros(n, dtype=torch.bool, device=node.device)
        gone[node[goes]] = True
        yield node[goes], neighbour, keys[gone[keys // count]]
        keys = _passed_on(keys, node[goes], neighbour, n, count)
        node = node[~goes]


def _passed_on(keys: Tensor, node: Tensor, neighbour: Tensor, n: int, count: int) -> Tensor:
    """What the blocks that stay see once `node` are gone: what they saw, and what their neighbours saw."""
    heir = torch.arange(n + 1, device=keys.device)[:, None].repeat(1, neighbour.shape[1])
    heir[node] = neighbour
    block, landmark = keys // count, keys % count
    heirs = heir[block]
    passed = (heirs * count + landmark[:, None])[heirs < n]
    return torch.unique(passed)


@dataclass
class _Builder:
    """Lays the levels out in the boundary store."""

    landmarks: _Landmarks
    rank: Tensor
    n: int
    group_size: int
    k: int
    batch_bytes: int

    def __post_init__(self) -> None:
        device = self.rank.device
        self.store_rows = 0
        self.places = 0
        self.batch_rows: list[int] = []
        self.first_row = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        self.group_of = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        self.groups = 0
        self.window_keys: list[Tensor] = []
        self.window_places: list[Tensor] = []
        # The blocks of a variable lie behind each other, and so do the variables.
        width = self.landmarks.width
        self.landmark_of = torch.repeat_interleave(torch.arange(len(width), device=device), width)
        self._keys = self._places = torch.zeros(0, dtype=torch.long, device=device)

    def windows(
        self, node: Tensor, neighbour: Tensor, keys: Tensor
    ) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Groups the blocks of a round, and gives every group its window and its rows in the store."""
        count, device = self.landmarks.count, node.device
        place = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        place[node] = torch.arange(len(node), device=device)
        block, landmark = place[keys // count], keys % count
        width = torch.zeros(len(node), dtype=torch.double, device=device)
        width.index_add_(0, block, self.landmarks.width[landmark].double())
        position = torch.zeros_like(width).index_add_(
            0, block, self.rank[landmark] * self.landmarks.width[landmark]
        ) / width.clamp_min(1)
        # Blocks that see lanes have windows several times as wide as those that see signs alone: keep them apart.
        wide = width > width.mean()
        order = torch.argsort(position + wide * (len(self.rank) + 1), stable=True)
        size = self.group_size
        if bool(width.mean() > self.landmarks.dim / 2):
            size = min(len(node), 4 * size)
        group_count = -(-len(node) // size)
        table = torch.full((group_count * size,), self.n, dtype=torch.long, device=device)
        table[: len(node)] = node[order]
        group = torch.empty(len(node), dtype=torch.long, device=device)
        group[order] = torch.arange(len(node), device=device) // size
        window = torch.unique(group[block] * count + landmark)
        of, landmark = window // count, window % count
        each = self.landmarks.width[landmark]
        # The gradient is every window's first column.
        start = each.cumsum(0) - each
        total = torch.zeros(group_count, dtype=torch.long, device=device).index_add_(0, of, each)
        start = start - (total.cumsum(0) - total)[of] + 1
        self.window_keys.append((self.groups + of) * count + landmark)
        self.window_places.append(start)
        padded = _padded(total + 1)
        table = table.view(group_count, size)
        batches = []
        for w in torch.unique(padded).tolist():
            members = torch.nonzero(padded == w)[:, 0]
            most = max(1, self.batch_bytes // (size * w * self.k * 8))
            for part in members.split(most):
                rows = self.store_rows + torch.arange(len(part) * size, device=device).mul_(w).view(
                    -1, size
                )
                self.first_row[table[part]] = rows
                self.group_of[table[part]] = self.groups + part[:, None].expand(-1, size)
                self.batch_rows.append(self.store_rows)
                batches.append((table[part], _expand(of, landmark, start, part, w, self)))
                self.store_rows += len(part) * size * w
        self.first_row[self.n] = self.group_of[self.n] = -1
        self.groups += group_count
        return node, neighbour, batches

    def level(
        self,
        node: Tensor,
        neighbour: Tensor,
        batches: list[tuple[Tensor, Tensor]],
        place: Tensor,
    ) -> Level:
        """The round with the rows that every fill-in goes to; once all rounds have their windows."""
        towards = torch.full(
            (self.n + 1, neighbour.shape[1]), self.n, dtype=torch.long, device=node.device
        )
        towards[node] = neighbour
        built = []
        for nodes, columns in batches:
            heir = towards[nodes]
            fill = self._fill_rows(columns, heir)
            here = slice(self.places, self.places + nodes.numel())
            self.places = here.stop
            beside = place[heir].flatten(0, 1)
            built.append(Batch(here, beside, columns, fill, self.batch_rows.pop(0)))
        return Level(tuple(built))

    def _fill_rows(self, columns: Tensor, heir: Tensor) -> Tensor:
        """Store rows [b, g, w, s] of the windows' columns at the heirs [b, g, s]."""
        dim = self.landmarks.dim
        known = columns < dim
        lm = rest = torch.zeros_like(columns)[:, None, :, None]
        if dim:
            at = torch.where(known, columns, 0)
            lm = self.landmark_of[at]
            lm, rest = lm[:, None, :, None], (at - self.landmarks.column[lm])[:, None, :, None]
        place, found = self._place(self.group_of[heir][:, :, None, :], lm)
        is_gradient = (columns == dim)[:, None, :, None]
        row = self.first_row[heir][:, :, None, :] + torch.where(is_gradient, 0, place + rest)
        has = (heir < self.n)[:, :, None, :]
        good = has & (is_gradient | (found & known[:, None, :, None]))
        return torch.where(good, row, self.store_rows)

    def rows(self, block: Tensor, landmark: Tensor) -> Tensor:
        """Store rows of factors' columns, one behind the other."""
        parts = []
        for at in range(landmark.shape[1]):
            lm = landmark[:, at]
            place, _ = self._place(self.group_of[block], lm)
            width = int(self.landmarks.width[lm[0]]) if len(lm) else 0
            start = self.first_row[block] + place
            parts.append(start[:, None] + torch.arange(width, device=block.device))
        return torch.cat(parts, dim=-1).flatten()

    def _place(self, group: Tensor, landmark: Tensor) -> tuple[Tensor, Tensor]:
        """Where a landmark stands in a group's window, and whether it does."""
        if self.window_keys:
            self._keys, self._places = torch.cat(self.window_keys), torch.cat(self.window_places)
            self.window_keys, self.window_places = [], []
        group, landmark = torch.broadcast_tensors(group, landmark)
        key = group * self.landmarks.count + landmark
        if not len(self._keys):
            return torch.zeros_like(key), torch.zeros_like(key, dtype=torch.bool)
        at = torch.searchsorted(self._keys, key).clamp_max(len(self._keys) - 1)
        return self._places[at], self._keys[at] == key


def _expand(
    of: Tensor, landmark: Tensor, start: Tensor, part: Tensor, w: int, builder: _Builder
) -> Tensor:
    """Columns [b, w] of the windows of the groups `part`."""
    marks = builder.landmarks
    columns = torch.full((len(part), w), marks.dim + 1, dtype=torch.long, device=of.device)
    columns[:, 0] = marks.dim
    row = torch.full((int(of.max()) + 1 if len(of) else 1,), -1, device=of.device)
    row = torch.cat((row, row.new_full((int(part.max()) + 1,), -1)))
    row[part] = torch.arange(len(part), device=of.device)
    mine = torch.nonzero(row[of] >= 0)[:, 0]
    each = marks.width[landmark[mine]]
    entry = torch.repeat_interleave(torch.arange(len(mine), device=of.device), each)
    rest = torch.arange(len(entry), device=of.device) - (each.cumsum(0) - each)[entry]
    at = mine[entry]
    columns[row[of[at]], start[at] + rest] = marks.column[landmark[at]] + rest
    return columns


def _padded(width: Tensor) -> Tensor:
    """Widths rounded up by at most an eighth, so that there are few different ones."""
    step = (2.0 ** (width.double().log2().floor() - 3)).clamp_min(4).long()
    return -(-width // step) * step
