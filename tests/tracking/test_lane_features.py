"""What association needs of lane detections, and what it costs to link two of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.sign_drive import F64, RIG, straight_poses

from crowdmap_torch.geometry import se3
from crowdmap_torch.tables import LaneDetections, LanePoints
from crowdmap_torch.tracking.lane_features import (
    METHODS,
    LaneAssociationConfig,
    LaneFeatures,
    lane_features,
    lane_pair_costs,
)

CONFIG = LaneAssociationConfig()


def detections(left_m: list[float], kind: list[int] | None = None) -> LaneDetections:
    n = len(left_m)
    return LaneDetections(
        torch.arange(n),
        torch.arange(n),
        torch.tensor(kind or [-1] * n, dtype=torch.int64),
        torch.ones(n, dtype=F64),
    )


def points(left_m: list[float], bend: float = 0.0) -> LanePoints:
    """Points of straight lines beside the car, or of a bend, 5 to 40 m ahead, in the image of a camera 1.45 m up."""
    ahead = torch.linspace(5, 40, 12, dtype=F64)
    left = torch.tensor(left_m, dtype=F64)[:, None] + bend * ahead.square()
    ideal = torch.stack((-left / ahead, (RIG.camera_height / ahead).expand_as(left)), dim=-1)
    owner = torch.arange(len(left_m)).repeat_interleave(len(ahead))
    return LanePoints(owner, 1000 * ideal.reshape(-1, 2), ideal.reshape(-1, 2))


def features_at(
    left_m: list[float],
    *,
    kind: list[int] | None = None,
    bend: float = 0.0,
    poses: Tensor | None = None,
    config: LaneAssociationConfig = CONFIG,
) -> LaneFeatures:
    T = straight_poses(1).expand(len(left_m), 4, 4) if poses is None else poses
    return lane_features(detections(left_m, kind), points(left_m, bend), RIG, T, config)


def test_curves_are_the_places_of_lines_on_the_road():
    features = features_at([-1.75, 1.75], bend=1e-3)
    expected = torch.tensor([[-1.75, 0, 1e-3], [1.75, 0, 1e-3]], dtype=F64)
    # A prior of flat, nearby lines pulls a little.
    torch.testing.assert_close(features.curve, expected, rtol=0, atol=0.01)
    torch.testing.assert_close(features.extent, torch.tensor([[5.0, 40.0]] * 2, dtype=F64))


def test_outlier_points_do_not_move_a_curve():
    bad = points([1.75])
    ideal = bad.ideal.clone()
    ideal[4] += 0.1
    features = lane_features(
        detections([1.75]), replace(bad, ideal=ideal), RIG, straight_poses(1), CONFIG
    )
    clean = features_at([1.75])
    # The error of a tenth of the focal length is over a metre; the others' line is within centimetres.
    torch.testing.assert_close(features.curve[:, 0], clean.curve[:, 0], rtol=0, atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_one_line_from_two_places_costs_less_than_two_lines(method: str):
    config = replace(CONFIG, method=method)
    poses = straight_poses(6)
    first = features_at([1.75, -1.75], poses=poses[:1].expand(2, 4, 4), config=config)
    later = features_at([1.75, -1.75], poses=poses[5:].expand(2, 4, 4), config=config)
    a, b = torch.tensor([0, 1, 0, 1]), torch.tensor([0, 1, 1, 0])
    cost = lane_pair_costs(first[a], later[b], config)
    gate = config.unmatched_cost if method == "ground" else config.paper.max_cost_px2
    assert cost[:2].max() < 0.1 * gate and cost[2:].min() > gate


def test_known_types_that_differ_cost_more():
    a, b = features_at([1.75] * 3, kind=[0, 0, -1]), features_at([1.75] * 3, kind=[0, 1, 1])
    same, other, unknown = lane_pair_costs(a, b, CONFIG).tolist()
    assert same == unknown and other == pytest.approx(same + CONFIG.type_penalty)


def test_costs_do_not_change_with_the_world():
    T = se3.retract(torch.eye(4, dtype=F64), torch.tensor([400.0, -70, 9, 0, 0, 1.1], dtype=F64))
    poses = straight_poses(6)[torch.tensor([0, 5])]
    for method in METHODS:
        config = replace(CONFIG, method=method)
        cost = [
            lane_pair_costs(f[torch.tensor([0])], f[torch.tensor([1])], config)
            for f in (
                features_at([1.7, 1.9], poses=poses, config=config),
                features_at([1.7, 1.9], poses=T @ poses, config=config),
            )
        ]
        # Poses hundreds of metres from the origin, seen at a thousand pixels a unit.
        torch.testing.assert_close(cost[0], cost[1], rtol=1e-6, atol=1e-6)


def test_a_line_without_points_in_reach_is_linked_with_nothing():
    far = replace(CONFIG, reach_m=(50.0, 60.0))
    features = features_at([1.75], config=far)
    assert features.extent.tolist() == [[-1.0, -1.0]]
    assert lane_pair_costs(features, features_at([1.75]), CONFIG).tolist() == [torch.inf]


@pytest.mark.parametrize("method", METHODS)
def test_no_detections_have_no_features_and_no_costs(method: str):
    none = features_at([])
    assert len(none) == len(lane_pair_costs(none, none, replace(CONFIG, method=method))) == 0


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="expected one of"):
        LaneAssociationConfig(method="optical flow")
