"""Lane pieces that points anywhere would have made too, and those that no chance makes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.road_drives import simulate

from crowdmap_torch.geometry.camera import unproject
from crowdmap_torch.lanes.existence import expected_by_chance
from crowdmap_torch.lanes.reconstruct import CHANCE, LaneConfig, reconstruct_lanes
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.estimate import RoadConfig, estimate_road
from crowdmap_torch.tables import Journey
from crowdmap_torch.tracking.lanes import LaneAssociationConfig, associate_lanes

COUNT = torch.tensor([4])
PIECE = torch.tensor([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]]).double()


def along(offset: Tensor, points: int = 8) -> tuple[Tensor, Tensor]:
    """Detections that run along the piece at these offsets, and which points are whose."""
    x = torch.linspace(5, 25, points).double().expand(len(offset), -1)
    point = torch.stack((x, offset[:, None].expand_as(x)), dim=-1)
    return point.flatten(0, 1), torch.arange(len(offset)).repeat_interleave(points)


def chance(point: Tensor, detection: Tensor) -> float:
    return float(expected_by_chance(PIECE, COUNT, point, detection, band=1.2, near=0.25)[0])


def uniform(n: int, seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return 2.4 * torch.rand(n, generator=g, dtype=torch.float64) - 1.2


def test_detections_that_agree_make_chance_impossible() -> None:
    assert chance(*along(torch.full((20,), 0.1).double())) == pytest.approx((0.25 / 1.2) ** 20)


@pytest.mark.parametrize("n", [1, 5, 50, 500])
def test_detections_anywhere_in_the_band_show_nothing(n: int) -> None:
    # Of twenty pieces laid without looking hardly any is as sure as one in a hundred.
    sure = [chance(*along(uniform(n, seed))) < 0.01 for seed in range(20)]
    assert sum(sure) <= 1


def test_a_marker_stands_out_of_as_many_false_detections() -> None:
    offset = torch.cat((torch.full((25,), 0.1).double(), uniform(25, 0)))
    assert chance(*along(offset)) < 1e-6


def test_a_kerb_beside_a_line_takes_nothing_from_it() -> None:
    offset = torch.tensor([0.0, 0.4]).double().repeat(25)
    assert chance(*along(offset)) < 1e-4


def test_detections_across_the_piece_do_not_count() -> None:
    point, detection = along(torch.full((20,), 0.1).double())
    y = torch.linspace(-1, 1, 5).double()
    across = torch.stack((torch.full_like(y, 15.0), y), dim=1).repeat(100, 1)
    both = torch.cat((point, across))
    whose = torch.cat((detection, 20 + torch.arange(100).repeat_interleave(5)))
    assert chance(both, whose) == chance(point, detection)


def test_detections_of_single_points_count() -> None:
    point, _ = along(torch.full((10,), 0.1).double(), points=1)
    assert chance(point, torch.arange(10)) == pytest.approx((0.25 / 1.2) ** 10)


def test_each_piece_is_judged_among_all() -> None:
    away = PIECE + torch.tensor([0.0, 10.0, 0.0]).double()
    point, detection = along(torch.full((20,), 0.1).double())
    both = torch.cat((PIECE, away))
    found = expected_by_chance(both, COUNT.repeat(2), point, detection, band=1.2, near=0.25)
    assert float(found[0]) == pytest.approx(2 * (0.25 / 1.2) ** 20)
    assert float(found[1]) == 2.0  # nothing was seen there


@pytest.fixture(scope="module")
def journey(tmp_path_factory: pytest.TempPathFactory) -> Journey:
    folder = tmp_path_factory.mktemp("existence") / "suburb"
    return simulate(folder, "suburb", length_m=200.0, seed=3).truths[0].journey


def hallucinating(journey: Journey, share: float, kind: str) -> Journey:
    """A share of the detections replaced by points, or by straight lines, anywhere below the horizon."""
    g = torch.Generator().manual_seed(0)
    points, camera = journey.lane_points, journey.rig.camera
    of = points.detection
    false = torch.rand(len(journey.lanes), generator=g) < share

    def anywhere(n: int) -> Tensor:
        return torch.rand(n, 2, generator=g, dtype=torch.float64)

    place = anywhere(len(of))
    if kind == "lines":
        begin, end = anywhere(len(false))[of], anywhere(len(false))[of]
        place = begin + place[:, :1] * (end - begin)
    horizon = float(camera.K[1, 2]) + 10
    low = place.new_tensor([0.0, horizon])
    size = place.new_tensor([camera.width, camera.height - horizon])
    px = torch.where(false[of][:, None], low + place * size, points.px)
    ideal, _ = unproject(camera, px)
    return replace(journey, lane_points=replace(points, px=px, ideal=ideal))


def mapped(journey: Journey, config: LaneConfig):
    road = estimate_road(journey, PositioningNoise(), RoadConfig())
    tracklets = associate_lanes(journey, LaneAssociationConfig())
    return reconstruct_lanes(journey, tracklets, road, config)


@pytest.mark.parametrize("kind", ["points", "lines"])
def test_noise_in_the_image_makes_no_lanes(journey: Journey, kind: str) -> None:
    noisy = hallucinating(journey, 1.0, kind)
    lanes, report = mapped(noisy, LaneConfig())
    assert len(lanes) <= 1  # one is what chance is allowed
    if kind == "lines":
        without, _ = mapped(noisy, LaneConfig(by_chance=1e6))
        assert len(without) > 50
        assert int((report.reason == CHANCE).sum()) > 10


def test_no_piece_of_a_good_drive_is_taken_for_chance(journey: Journey) -> None:
    lanes, _ = mapped(journey, LaneConfig())
    without, _ = mapped(journey, LaneConfig(by_chance=1e6))
    assert len(lanes) == len(without) > 20
