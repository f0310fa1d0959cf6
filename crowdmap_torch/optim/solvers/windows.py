"""Where the fill-in of eliminated blocks is kept: windows of columns, and their rows in one store.

An eliminated block leaves fill-in in the columns of the landmarks that it is coupled to, by then: its window. Blocks that
see the same stretch of road, driven by anybody, form a group with one window, so that their products are one matrix product.
Groups of the same width are computed together, in batches of bounded size. The store has one row per block and column of
its window, and is as wide as a block; batch follows batch in it.

Landmarks that are seen together have columns near each other. Where a window is wide and of few runs of columns, a processor
subtracts its products from the tiles in place, run by run, above the diagonal alone; else they are scattered.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.layout import Layout
from crowdmap_torch.optim.solvers.sparse_tiles import TilePattern
from crowdmap_torch.processes.sums import add_at

_WORTH_RUNS = 160
"""Width from which a window's products are worth a call for each pair of its runs."""
_RUN = 64
"""Mean length of runs from which they are worth it too."""
_APART = 0.25
"""Blocks whose windows begin further apart than this share of their width are not in one group."""
_GAP = 2
"""Landmarks that are taken into a window to join two runs of columns, at most."""


class Product(NamedTuple):
    """Some rows of a group's window times others: what leaves a part of the reduced system."""

    group: int
    """Of the batch."""
    rows: slice
    beside: slice
    """Rows of the window, the others of them."""
    tile: int
    """Number of the tile of the reduced system that they leave; -1: its right-hand side."""
    here: tuple[slice, slice]
    """The part of the tile, as its rows and columns."""


@dataclass(frozen=True)
class Batch:
    """Groups of equal width whose blocks are eliminated together; `b` groups of `g` places."""

    place: slice
    """Places of the order of elimination, group by group."""
    columns: Int[Tensor, "b w"]
    """The windows: columns of the reduced system; first its right-hand side, `dim`, and `dim + 1` for padding."""
    fill: Int[Tensor, "b g w s"]
    """Row of the store that each entry's fill-in goes to, for every neighbour of the block."""
    first_row: int
    """Where the batch's rows begin in the store."""
    products: tuple[tuple[int, Product], ...] | None
    """The row of tiles and the product of every pair of runs; None: they are scattered."""


@dataclass(frozen=True)
class Round:
    """Blocks that do not touch each other, eliminated at once."""

    place: slice
    """Places of the order of elimination, batch by batch."""
    neighbour: Int[Tensor, "e s"]
    """Places of the blocks that each is linked to: before and behind it in the chain, or a leaf's carrier; the
    last place of all for none."""
    batches: tuple[Batch, ...]

    def of_batch(self, batch: Batch) -> slice:
        """The batch's places among those of the round."""
        first = self.place.start
        return slice(batch.place.start - first, batch.place.stop - first)


@dataclass(frozen=True)
class LandmarkBlocks:
    """The blocks of the variables that stay, numbered behind each other, and their columns in any order."""

    first: dict[str, int]
    """Number of each variable's first block."""
    column: Int[Tensor, " q"]
    """First column of every block."""
    width: Int[Tensor, " q"]
    width_of: dict[str, int]
    """Of the blocks of each variable."""
    dim: int
    """Columns of the whole system."""
    ordered: Int[Tensor, " q"]
    """The blocks in the order of their columns."""
    position: Int[Tensor, " q"]
    """Where in that order each is."""
    of_column: Int[Tensor, " dim"]
    """The block of every column; that before it of a column that is nobody's."""

    @classmethod
    def of(cls, where: Layout, device: torch.device, skip: Collection[str] = ()) -> LandmarkBlocks:
        """Those of a reduced system, the variables `skip`, whose columns are the last, left out."""
        first, columns, widths, total = {}, [], [], 0
        for name, offset in where.offset.items():
            if name in skip:
                continue
            first[name] = total
            total += len(offset)
            columns.append(offset)
            widths.append(torch.full_like(offset, where.tangent_dim[name]))
        none = torch.zeros(0, dtype=torch.long, device=device)
        column, width = torch.cat([none, *columns]), torch.cat([none, *widths])
        ordered = torch.argsort(column)
        begins = torch.cat((column[ordered], torch.full((1,), where.dim, device=device)))
        return cls(
            first=first,
            column=column,
            width=width,
            width_of={name: where.tangent_dim[name] for name in first},
            dim=where.dim,
            ordered=ordered,
            position=torch.argsort(ordered),
            of_column=torch.repeat_interleave(ordered, begins.diff()),
        )

    def columns(self, landmark: Int[Tensor, "f q"], widths: Sequence[int]) -> Int[Tensor, "f w"]:
        """All columns of some landmarks of these widths."""
        parts = [
            self.column[lm][:, None] + torch.arange(width, device=lm.device)
            for lm, width in zip(landmark.unbind(1), widths, strict=True)
        ]
        return torch.cat(parts, dim=-1)

    @property
    def count(self) -> int:
        """At least one, so that keys can be taken apart."""
        return max(len(self.column), 1)


@dataclass
class WindowBuilder:
    """Lays the rounds out in the store."""

    landmarks: LandmarkBlocks
    n: int
    group_size: int
    k: int
    batch_bytes: int

    def __post_init__(self) -> None:
        device = self.landmarks.column.device
        self.in_place = _in_place(device)
        self.store_rows = 0
        self.places = 0
        self.batch_rows: list[int] = []
        self.first_row = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        self.group_of = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        self.groups = 0
        self.window_keys: list[Tensor] = []
        self.window_places: list[Tensor] = []
        self._keys = self._places = torch.zeros(0, dtype=torch.long, device=device)

    def windows(
        self, node: Tensor, neighbour: Tensor, keys: Tensor
    ) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor, bool]]]:
        """Groups the blocks of a round, and gives every group its window and its rows in the store."""
        count, device = self.landmarks.count, node.device
        place = torch.full((self.n + 1,), -1, dtype=torch.long, device=device)
        place[node] = torch.arange(len(node), device=device)
        block, landmark = place[keys // count], keys % count
        width = torch.zeros(len(node), dtype=torch.double, device=device)
        add_at(width, 0, block, self.landmarks.width[landmark].double())
        first = torch.full((len(node),), self.landmarks.dim, device=device)
        first.scatter_reduce_(0, block, self.landmarks.column[landmark], "amin")
        table, group = self._groups(node, first, width)
        group_count, size = table.shape
        window = torch.unique(group[block] * count + self.landmarks.position[landmark])
        window = _joined(window, count)
        of, landmark = window // count, self.landmarks.ordered[window % count]
        each = self.landmarks.width[landmark]
        # The gradient is every window's first column.
        start = each.cumsum(0) - each
        total = add_at(torch.zeros(group_count, dtype=torch.long, device=device), 0, of, each)
        start = start - (total.cumsum(0) - total)[of] + 1
        self.window_keys.append(self.groups * count + window)
        self.window_places.append(start)
        padded = _padded(total + 1)
        breaks = torch.ones_like(window, dtype=torch.bool)
        breaks[1:] = window[1:] != window[:-1] + 1
        breaks[1:] |= of[1:] != of[:-1]
        runs = add_at(torch.zeros_like(total), 0, of, breaks.long())
        in_runs = (total >= _WORTH_RUNS) & (total >= _RUN * runs) & self.in_place
        batches = []
        for kind in torch.unique(2 * padded + in_runs).tolist():
            w, by_run = kind // 2, bool(kind % 2)
            members = torch.nonzero(2 * padded + in_runs == kind)[:, 0]
            most = max(1, self.batch_bytes // (size * w * self.k * 8))
            for part in members.split(most):
                rows = self.store_rows + torch.arange(len(part) * size, device=device).mul_(w).view(
                    -1, size
                )
                self.first_row[table[part]] = rows
                self.group_of[table[part]] = self.groups + part[:, None].expand(-1, size)
                self.batch_rows.append(self.store_rows)
                columns = _expand(of, landmark, start, part, w, group_count, self)
                batches.append((table[part], columns, by_run))
                self.store_rows += len(part) * size * w
        self.first_row[self.n] = self.group_of[self.n] = -1
        self.groups += group_count
        return node, neighbour, batches

    def _groups(
        self, node: Int[Tensor, " g"], first: Int[Tensor, " g"], width: Float[Tensor, " g"]
    ) -> tuple[Int[Tensor, "b s"], Int[Tensor, " g"]]:
        """Groups of blocks that begin near each other in the reduced system, and each block's; `n` where there are fewer."""
        # Blocks that see lanes have windows several times as wide as those that see signs alone: keep them apart.
        wide = width > width.mean()
        order = torch.argsort(first + wide * (self.landmarks.dim + 1), stable=True)
        first, width = first[order], width[order]
        begins = torch.ones_like(first, dtype=torch.bool)
        begins[1:] = (first[1:] - first[:-1]).abs() > _APART * torch.maximum(width[1:], width[:-1])
        run = begins.cumsum(0) - 1
        count = torch.bincount(run)
        place = torch.arange(len(node), device=node.device) - (count.cumsum(0) - count)[run]
        groups = -(-count // self.group_size)
        each = -(-count // groups)
        group = (groups.cumsum(0) - groups)[run] + place // each[run]
        table = torch.full((int(groups.sum()), int(each.max())), self.n, device=node.device)
        table[group, place % each[run]] = node[order]
        of_node = torch.empty_like(group)
        of_node[order] = group
        return table, of_node

    def round(
        self,
        node: Tensor,
        neighbour: Tensor,
        batches: list[tuple[Tensor, Tensor, bool]],
        place: Tensor,
        pattern: TilePattern,
    ) -> Round:
        """The round with the rows that every fill-in goes to; once all rounds have their windows."""
        towards = torch.full(
            (self.n + 1, neighbour.shape[1]), self.n, dtype=torch.long, device=node.device
        )
        towards[node] = neighbour
        built, beside, first = [], [], self.places
        for nodes, columns, by_run in batches:
            receiver = towards[nodes]
            fill = self._fill_rows(columns, receiver)
            here = slice(self.places, self.places + nodes.numel())
            self.places = here.stop
            beside.append(place[receiver].flatten(0, 1))
            products = self._products(columns, pattern) if by_run else None
            built.append(Batch(here, columns, fill, self.batch_rows.pop(0), products))
        return Round(slice(first, self.places), torch.cat(beside), tuple(built))

    def bound(self) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
        """The groups so far, and the places of the landmarks in their windows, in the order of columns."""
        keys = self._sorted()
        return keys // self.landmarks.count, keys % self.landmarks.count

    def _products(self, columns: Tensor, pattern: TilePattern) -> tuple[tuple[int, Product], ...]:
        """The pairs of runs of windows within a tile, and the row of tiles that each pair is in."""
        dim, width, products = pattern.dim, pattern.width, []
        before = torch.nn.functional.pad(columns, (1, 0), value=-1)[:, :-1]
        begins = (columns < dim) & ((columns != before + 1) | (columns % width == 0))
        group, first = torch.nonzero(begins, as_tuple=True)
        column = columns[group, first]
        total = (columns < dim).sum(1) + 1
        last = torch.cat((first[1:], first.new_zeros(1)))
        last = torch.where(last > first, last, total[group])
        runs = torch.stack((group, first, last, column), dim=1).tolist()
        ends = torch.searchsorted(group, group, right=True).tolist()
        number = pattern.number
        for i, (b, start, stop, at) in enumerate(runs):
            rows, tile = slice(start, stop), at // width
            right = slice(at, at + stop - start)
            products.append((-1, Product(b, slice(0, 1), rows, -1, (slice(0, 1), right))))
            here = slice(at % width, at % width + stop - start)
            for _, begin, end, column_of in runs[i : ends[i]]:
                there = slice(column_of % width, column_of % width + end - begin)
                into = number[tile][column_of // width]
                products.append((tile, Product(b, rows, slice(begin, end), into, (here, there))))
        return tuple(products)

    def _fill_rows(self, columns: Tensor, receiver: Tensor) -> Tensor:
        """Store rows [b, g, w, s] of the windows' columns at the receivers [b, g, s]."""
        dim = self.landmarks.dim
        known = columns < dim
        lm = rest = torch.zeros_like(columns)[:, None, :, None]
        if len(self.landmarks.column):
            at = torch.where(known, columns, 0)
            lm = self.landmarks.of_column[at]
            lm, rest = lm[:, None, :, None], (at - self.landmarks.column[lm])[:, None, :, None]
        place, found = self._place(self.group_of[receiver][:, :, None, :], lm)
        is_gradient = (columns == dim)[:, None, :, None]
        row = self.first_row[receiver][:, :, None, :] + torch.where(is_gradient, 0, place + rest)
        has = (receiver < self.n)[:, :, None, :]
        good = has & (is_gradient | (found & known[:, None, :, None]))
        row = torch.where(good, row, self.store_rows)
        # A tenth of what an adjustment holds, on a CPU. On a GPU their order is kept with them, and they are not converted.
        return row.to(torch.int32) if row.device.type == "cpu" else row

    def rows(self, block: Tensor, landmark: Tensor, widths: Sequence[int]) -> Tensor:
        """Store rows of factors' columns, one behind the other; the landmarks have these widths."""
        parts = []
        for lm, width in zip(landmark.unbind(1), widths, strict=True):
            place, _ = self._place(self.group_of[block], lm)
            start = self.first_row[block] + place
            parts.append(start[:, None] + torch.arange(width, device=block.device))
        return torch.cat(parts, dim=-1).flatten()

    def _sorted(self) -> Int[Tensor, " n"]:
        """Keys `group * count + place` of all windows."""
        if self.window_keys:
            self._keys = torch.cat([self._keys, *self.window_keys])
            self._places = torch.cat([self._places, *self.window_places])
            self.window_keys, self.window_places = [], []
        return self._keys

    def _place(self, group: Tensor, landmark: Tensor) -> tuple[Tensor, Tensor]:
        """Where a landmark stands in a group's window, and whether it does."""
        self._sorted()
        group, landmark = torch.broadcast_tensors(group, landmark)
        if not len(self._keys):
            return torch.zeros_like(landmark), torch.zeros_like(landmark, dtype=torch.bool)
        key = group * self.landmarks.count + self.landmarks.position[landmark]
        at = torch.searchsorted(self._keys, key).clamp_max(len(self._keys) - 1)
        return self._places[at], self._keys[at] == key


def _expand(
    of: Tensor,
    landmark: Tensor,
    start: Tensor,
    part: Tensor,
    w: int,
    groups: int,
    builder: WindowBuilder,
) -> Tensor:
    """Columns [b, w] of the windows of the groups `part`."""
    landmarks = builder.landmarks
    columns = torch.full((len(part), w), landmarks.dim + 1, dtype=torch.long, device=of.device)
    columns[:, 0] = landmarks.dim
    row = torch.full((groups,), -1, device=of.device)
    row[part] = torch.arange(len(part), device=of.device)
    mine = torch.nonzero(row[of] >= 0)[:, 0]
    each = landmarks.width[landmark[mine]]
    entry = torch.repeat_interleave(torch.arange(len(mine), device=of.device), each)
    rest = torch.arange(len(entry), device=of.device) - (each.cumsum(0) - each)[entry]
    at = mine[entry]
    columns[row[of[at]], start[at] + rest] = landmarks.column[landmark[at]] + rest
    return columns


def _in_place(device: torch.device) -> bool:
    """Whether products may be subtracted in place, run by run: where a call costs little."""
    return device.type == "cpu"


def _joined(window: Int[Tensor, " n"], count: int) -> Int[Tensor, " m"]:
    """Sorted keys `group * count + place` with those between that close small gaps of a group."""
    gap = window[1:] - window[:-1] - 1
    gap = torch.where(window[1:] // count == window[:-1] // count, gap, 0)
    more = torch.nn.functional.pad(torch.where(gap <= _GAP, gap, 0), (0, 1))[: len(window)] + 1
    entry = torch.repeat_interleave(torch.arange(len(window), device=window.device), more)
    first = (more.cumsum(0) - more)[entry]
    return window[entry] + torch.arange(len(entry), device=window.device) - first


def _padded(width: Tensor) -> Tensor:
    """Widths rounded up by at most an eighth, so that there are few different ones."""
    step = (2.0 ** (width.double().log2().floor() - 3)).clamp_min(4).long()
    return -(-width // step) * step
