"""Lengths of natural cubic splines, and points at equal distances along them (IV-D, V-A)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry.spline_basis import derivative_flat, evaluate_flat, rows
from crowdmap_torch.processes.sums import running_sum

# Gauss-Legendre on 0 .. 1, five nodes: exact up to degree nine on each half of a span between
# knots.
_OFFSET = math.sqrt(10 / 7)
_OUTER, _INNER = math.sqrt(5 + 2 * _OFFSET) / 3, math.sqrt(5 - 2 * _OFFSET) / 3
_NODES = tuple(0.5 + 0.5 * x for x in (-_OUTER, -_INNER, 0.0, _INNER, _OUTER))
_OUTER_WEIGHT, _INNER_WEIGHT = (322 - 13 * math.sqrt(70)) / 1800, (322 + 13 * math.sqrt(70)) / 1800
_WEIGHTS = (_OUTER_WEIGHT, _INNER_WEIGHT, 64 / 225, _INNER_WEIGHT, _OUTER_WEIGHT)
_PARTS = 8
"""Parts of a span whose lengths are tabulated, for the way back from length to parameter."""

_SAMPLE_ROUNDS = 4
"""How often samples that came out too far apart are made denser."""


def arc_length_flat(control: Float[Tensor, "c k"], count: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Lengths of packed splines [m]."""
    return _lengths(_part_lengths(control, count), count)


def parameter_at_length_flat(
    control: Float[Tensor, "c k"],
    count: Int[Tensor, " n"],
    length: Float[Tensor, " m"],
    spline: Int[Tensor, " m"],
) -> Float[Tensor, " m"]:
    """Parameters, within 0 .. C - 1, at given lengths [m] from the starts of packed splines."""
    return _parameter_at_length(control, count, length, spline, _part_lengths(control, count))


_Parts = tuple[Tensor, Tensor, Tensor]
"""Length, spline and first parameter of each part of each span of packed splines, in order."""


def _parameter_at_length(
    control: Tensor, count: Tensor, length: Tensor, spline: Tensor, parts: _Parts
) -> Tensor:
    part_length, part_spline, part_start = parts
    # One running length over all splines; each starts where the one before ended.
    running = torch.cat((part_length.new_zeros(1), running_sum(part_length)))
    part_count = (count - 1) * _PARTS
    first_part = part_count.cumsum(0) - part_count
    last_part = first_part + part_count - 1
    low, high = running[first_part[spline]], running[last_part[spline] + 1]
    target = torch.minimum(low + length.clamp_min(0), high)
    part = torch.searchsorted(running, target.contiguous(), right=True) - 1
    part = torch.minimum(torch.maximum(part, first_part[spline]), last_part[spline])
    begin = part_start[part]
    left = target - running[part]
    t = begin + left / part_length[part].clamp_min(1e-12) / _PARTS
    end = begin + 1 / _PARTS
    for _ in range(3):
        covered = _length_between(control, count, begin, t, part_spline[part])
        speed = derivative_flat(control, count, t, part_spline[part]).square().sum(-1).sqrt()
        t = torch.minimum(torch.maximum(t - (covered - left) / speed.clamp_min(1e-12), begin), end)
    return t


def sample_flat(
    control: Float[Tensor, "c k"], count: Int[Tensor, " n"], spacing: float
) -> tuple[Float[Tensor, "m k"], Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Points at equal distances of at most `spacing` [m] along packed splines, both ends included.

    Returns the points, their parameters and the spline of each; those of one spline are adjacent
    and in order.
    """
    parts = _part_lengths(control, count)
    length = _lengths(parts, count)
    # a trace less, so that ten metres are ten spans of a metre, whatever the rounding
    spans = (length / spacing - 1e-9).ceil().clamp_min(1).long()
    point, t, spline, longest = _sample(control, count, length, spans, parts)
    for _ in range(_SAMPLE_ROUNDS):
        # Where a spline all but stands still its length is known less well than elsewhere.
        over = longest > spacing * (1 + 1e-9)
        if not over.any():
            break
        spans = torch.where(over, (spans * longest / spacing).ceil().long() + 1, spans)
        point, t, spline, longest = _sample(control, count, length, spans, parts)
    return point, t, spline


def _sample(
    control: Tensor, count: Tensor, length: Tensor, spans: Tensor, parts: _Parts
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, their parameters and splines, and the longest chord of each spline."""
    t, spline = _even_parameters(control, count, length, spans + 1, parts)
    point = evaluate_flat(control, count, t, spline)
    chord = (point[1:] - point[:-1]).square().sum(-1).sqrt()
    within = torch.where(spline[1:] == spline[:-1], chord, 0.0)
    longest = chord.new_zeros(len(count)).scatter_reduce(0, spline[1:], within, "amax")
    return point, t, spline, longest


def _even_parameters(
    control: Tensor, count: Tensor, length: Tensor, number: Tensor, parts: _Parts
) -> tuple[Tensor, Tensor]:
    spline, rank = rows(number)
    last = number[spline] - 1
    along = length[spline] * rank / last.clamp_min(1)
    t = _parameter_at_length(control, count, along, spline, parts)
    # The ends exactly.
    end = (count[spline] - 1).to(t)
    return torch.where(rank == 0, 0.0, torch.where(rank == last, end, t)), spline


def _part_lengths(control: Tensor, count: Tensor) -> _Parts:
    spline, rank = rows((count - 1) * _PARTS)
    start = rank.to(control) / _PARTS
    return _length_between(control, count, start, start + 1 / _PARTS, spline), spline, start


def _lengths(parts: _Parts, count: Tensor) -> Tensor:
    length, spline, _ = parts
    return length.new_zeros(len(count)).index_add(0, spline, length)


def _length_between(
    control: Tensor, count: Tensor, start: Tensor, end: Tensor, spline: Tensor
) -> Tensor:
    nodes, weights = control.new_tensor(_NODES), control.new_tensor(_WEIGHTS)
    t = start[:, None] + (end - start)[:, None] * nodes
    every = spline[:, None].expand_as(t)
    speed = derivative_flat(control, count, t.flatten(), every.flatten()).square().sum(-1).sqrt()
    return (end - start) * (speed.reshape(t.shape) * weights).sum(-1)
