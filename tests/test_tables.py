"""The nouns: what a prompt shows of them, and frames taken out of a drive."""

from __future__ import annotations

import torch

from crowdmap_torch.io.truth import SignAssociations
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Dataset, Survey


def test_what_a_prompt_shows_is_a_line_of_counts(
    tiny: Dataset, tiny_survey: Survey, tiny_result: MapResult
):
    journey, hd_map = tiny.journeys[0], tiny_result.hd_map
    frames = sum(j.frame_count for j in tiny.journeys)
    for value, words in (
        (tiny, ("Dataset(3 journeys, 0 set aside", f"{frames} frames", str(tiny.origin))),
        (journey, ("Journey('journey-000': ", f"{len(journey.signs)} sign and ", " m)")),
        (hd_map, (f"HdMap({len(hd_map.signs)} signs, {len(hd_map.lanes)} lane pieces, ",)),
        (tiny_survey, (f"Survey({len(tiny_survey.signs)} signs, ",)),
        (tiny_result, ("MapResult(HdMap(", "of 3 journeys: converged")),
        (hd_map.signs, (f"Signs({len(hd_map.signs)} rows)",)),
        (SignAssociations(*torch.zeros(3, 0, dtype=torch.int64)), ("SignAssociations(0 rows)",)),
    ):
        shown = repr(value)
        assert [word for word in words if word not in shown] == []
        assert len(shown) < 250 and "tensor" not in shown and "\n" not in shown


def test_frames_come_with_what_was_detected_in_them_in_the_order_asked_for(tiny: Dataset):
    journey = tiny.journeys[0]
    frames = torch.tensor([30, 5, 5, 12])
    part = journey.with_frames(frames)
    assert torch.equal(part.frame_number, journey.frame_number[frames])
    for now, before in ((part.signs, journey.signs), (part.lanes, journey.lanes)):
        expected = [torch.nonzero(before.frame == k)[:, 0] for k in frames.tolist()]
        assert torch.equal(
            torch.bincount(now.frame, minlength=4), torch.tensor([*map(len, expected)])
        )
        assert torch.equal(now.score, before.score[torch.cat(expected)])
    assert torch.equal(
        part.signs.corners_px[part.signs.frame == 1], part.signs.corners_px[part.signs.frame == 2]
    )
    rows = torch.cat([torch.nonzero(journey.lanes.frame == k)[:, 0] for k in frames.tolist()])
    points = [journey.lane_points.px[journey.lane_points.detection == k] for k in rows.tolist()]
    assert torch.equal(part.lane_points.px, torch.cat(points))
