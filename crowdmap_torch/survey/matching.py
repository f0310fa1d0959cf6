"""Which sign of the map is which sign of the survey (METRICS.md, Signs)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.ranges import Cost, Length, Settings
from crowdmap_torch.tables import Signs, SurveySigns

DUPLICATE, FALSE, MATCHED = -1, -2, 0
"""What `SurveyMatch.true_of_map` says of map signs that are matched to none; from `MATCHED` on it is
a survey row."""


@dataclass(frozen=True)
class SurveyMatchConfig(Settings):
    """How signs of a map are matched to those of a survey."""

    gate_m: Length = 3.0
    """Centres further apart are never one sign (2 m on kitti-signs)."""
    shape_penalty_m: Cost = 0.75
    """Its square is added to the squared distance where the shapes differ."""
    facing_penalty_m: Cost = 1.5
    """Its square is added where the map sign faces away from where the true one faces."""
    duplicate_radius_m: Length = 3.0
    """An unmatched map sign this near to a true sign is a duplicate, else it is false."""


@dataclass(frozen=True)
class SurveyMatch:
    """A one-to-one matching of map signs and survey signs."""

    map_row: Int[Tensor, " k"]
    true_row: Int[Tensor, " k"]
    """The survey sign of each matched map sign, ascending."""
    true_of_map: Int[Tensor, " n"]
    """For every map sign its survey sign, or `DUPLICATE`, or `FALSE`."""
    shift: Float[Tensor, " 3"]
    """Median over the matched signs of map centre minus true centre [m]; zero if none is
    matched."""


def match_to_survey(signs: Signs, survey: SurveySigns, config: SurveyMatchConfig) -> SurveyMatch:
    """The optimal assignment of map signs to survey signs within the gate.

    A sign may stay unmatched at the cost of the largest admissible pair, so that a false sign
    never makes its neighbours swap partners. The assignment is repeated once with the median
    shift of the first taken off.
    """
    shift = signs.center_world.new_zeros(3)
    map_row, true_row = _assign(signs, survey, shift, config)
    if len(map_row):
        shift = _median_shift(signs, survey, map_row, true_row)
        map_row, true_row = _assign(signs, survey, shift, config)
    distance = _distance_to_nearest(signs.center_world - shift, survey.center_world)
    true_of_map = torch.where(distance <= config.duplicate_radius_m, DUPLICATE, FALSE)
    true_of_map = true_of_map.index_put((map_row,), true_row)
    if len(map_row):
        shift = _median_shift(signs, survey, map_row, true_row)
    return SurveyMatch(map_row=map_row, true_row=true_row, true_of_map=true_of_map, shift=shift)


def _median_shift(
    signs: Signs, survey: SurveySigns, map_row: Tensor, true_row: Tensor
) -> Float[Tensor, " 3"]:
    offset = signs.center_world[map_row] - survey.center_world[true_row]
    # The mean of the two middle values for an even number, unlike Tensor.median: no side is
    # preferred.
    return torch.quantile(offset, 0.5, dim=0)


def _assign(
    signs: Signs, survey: SurveySigns, shift: Float[Tensor, " 3"], config: SurveyMatchConfig
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Rows of the map and of the survey that belong together once `shift` is taken off the map."""
    true_row, map_row, distance = pairs_between(
        survey.center_world, signs.center_world - shift, radius=config.gate_m
    )
    differs = survey.shape[true_row] != signs.shape[map_row]
    # A normal that was not surveyed is NaN, and NaN < 0 is false: no penalty.
    away = (survey.normal_world[true_row] * signs.normal_world[map_row]).sum(-1) < 0
    cost = distance.square()
    cost = cost + config.shape_penalty_m**2 * differs + config.facing_penalty_m**2 * away
    worst = config.gate_m**2 + config.shape_penalty_m**2 + config.facing_penalty_m**2
    return _sparse_assignment(true_row, map_row, cost, (len(survey), len(signs)), worst)


def _sparse_assignment(
    row: Tensor, column: Tensor, cost: Tensor, shape: tuple[int, int], cost_of_none: float
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Columns and rows of the cheapest partial assignment over the listed pairs only."""
    rows, columns = shape
    if len(row) == 0:
        empty = row.new_zeros(0)
        return empty, empty
    # One private dummy column for each row makes a full matching exist. Every row takes exactly one
    # column, so adding 1 to all costs changes nothing, and no cost is an (implicitly absent) zero.
    own = np.arange(rows)
    graph = csr_matrix(
        (
            np.concatenate((cost.cpu().numpy(), np.full(rows, cost_of_none))) + 1.0,
            (
                np.concatenate((row.cpu().numpy(), own)),
                np.concatenate((column.cpu().numpy(), columns + own)),
            ),
        ),
        shape=(rows, columns + rows),
    )
    chosen_row, chosen_column = min_weight_full_bipartite_matching(graph)
    real = chosen_column < columns
    order = np.argsort(chosen_row[real], kind="stable")
    chosen = [torch.as_tensor(c[real][order].astype(np.int64)) for c in (chosen_column, chosen_row)]
    return chosen[0].to(row.device), chosen[1].to(row.device)


def _distance_to_nearest(
    point_world: Float[Tensor, "n 3"], other_world: Float[Tensor, "m 3"]
) -> Float[Tensor, " n"]:
    if len(other_world) == 0 or len(point_world) == 0:
        return torch.full_like(point_world[:, 0], torch.inf)
    distance, _ = KDTree(other_world.cpu().numpy()).query(point_world.detach().cpu().numpy())
    return torch.as_tensor(distance).to(point_world)
