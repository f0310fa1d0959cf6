from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from crowdmap_torch.evaluation.evaluate import (
    against,
    control_ids_of,
    evaluate_map,
    progress_scalars,
)
from crowdmap_torch.evaluation.single_journey import JourneyLandmarks
from crowdmap_torch.evaluation.text import format_figures
from crowdmap_torch.io.area import Area
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import JourneyTruth, SignAssociations, Truth
from crowdmap_torch.tables import Origin


@pytest.fixture
def simulated(build):
    """A survey of three signs and two markers, and three drives that see all of it."""
    true = build.signs([[40.0, 4, 2], [60, -4, 2], [80, 4, 2]])
    lines = [build.straight(2.0), build.straight(-1.5)]
    survey = build.survey(true, lines)
    sign_rows = [(frame, sign) for sign in range(3) for frame in range(20, 32)]
    lane_rows = [(frame, lane) for frame in range(80) for lane in range(2)]
    points = [[(4, y), (20, y)] for _ in range(80) for y in (2.0, -1.5)]
    truth = Truth(
        tuple(
            build.drive(
                name, bias=bias, sign_rows=sign_rows, lane_rows=lane_rows, lane_points=points
            )
            for name, bias in (("a", (0.3, 0, 0)), ("b", (0.3, 0, 0)), ("c", (0.0, 0, 0)))
        )
    )
    return true, lines, survey, truth


def test_everything_is_told_of_simulated_data(build, simulated):
    true, lines, survey, truth = simulated
    hd_map = build.hd_map(build.moved(true, (0.4, 0, 0)), build.lanes(lines), shared=0.03)
    rows = torch.arange(36)
    associations = SignAssociations(torch.zeros(36, dtype=torch.int64), rows, rows // 12)
    landmarks = [JourneyLandmarks("a", build.moved(true, (0.3, 0, 0)), build.lanes(lines[:1]))]
    figures = evaluate_map(
        hd_map, survey, truth=truth, associations=associations, landmarks=landmarks
    )
    assert figures.signs.observable == 3
    assert figures.oracle is not None
    assert figures.oracle.total.mean == pytest.approx(0.2)
    assert figures.absolute_over_oracle == pytest.approx(2.0)
    assert figures.lanes is not None
    assert 90 < figures.lanes.seen_length_m / 2 <= 96.5
    assert figures.lanes.recall == 1
    assert figures.association is not None
    assert figures.association.data_loss == pytest.approx(2 / 3)
    assert figures.single_journey is not None
    assert figures.single_journey.corner.total.mean == pytest.approx(0, abs=1e-9)
    text = format_figures(figures)
    for word in ("oracle", "relative", "Lanes", "Association", "Uncertainty", "One journey"):
        assert word in text


def test_figures_are_plain_json_without_nan(build, simulated):
    true, _, survey, _ = simulated
    figures = evaluate_map(
        build.hd_map(true), replace(survey, signs=build.centers_only(survey.signs))
    )
    tree = json.loads(json.dumps(figures.as_dict(), allow_nan=False))
    assert tree["signs"]["absolute"]["total"]["mean"] is None
    assert tree["signs"]["absolute_center"]["total"]["mean"] == pytest.approx(0)
    assert tree["oracle"] is None


def test_control_signs_are_left_out(build, simulated):
    true, _, survey, truth = simulated
    figures = evaluate_map(build.hd_map(true), survey, truth=truth, control_ids=("s1",))
    assert figures.control_signs == 1
    assert figures.signs.observable == figures.signs.matched == 2
    with pytest.raises(ValueError, match="'s9' is not in the survey"):
        evaluate_map(build.hd_map(true), survey, control_ids=("s9",))


def test_what_is_asked_of_a_map_may_be_known(build, simulated):
    true, _, survey, truth = simulated
    hd_map = build.hd_map(true)
    asked = against(survey, truth=truth, control_ids=("s1",))
    known = evaluate_map(hd_map, survey, truth=truth, asked=asked)
    assert (
        known.as_dict() == evaluate_map(hd_map, survey, truth=truth, control_ids=("s1",)).as_dict()
    )


def test_control_signs_are_known_by_id_or_by_place(build, simulated):
    true, _, survey, _ = simulated
    control = replace(build.survey(build.moved(true, (0.05, 0, 0))), sign_id=("s0", "other", "far"))
    far = control.signs.center_world.clone()
    far[2, 0] += 50
    control = replace(control, signs=replace(control.signs, center_world=far))
    assert control_ids_of(control, survey) == ("s0", "s1")


def test_observable_signs_may_be_named(build, simulated):
    true, _, survey, _ = simulated
    figures = evaluate_map(build.hd_map(true[torch.arange(1)]), survey, observable_ids=("s0", "s2"))
    assert figures.signs.recall == 0.5


def test_a_map_of_an_area_is_judged_by_what_stands_in_it(build, simulated):
    true, _, survey, truth = simulated
    x = true.center_world[:, 0]
    first = build.hd_map(true[x.argsort()[:1]])
    cut = replace(first, provenance={"bbox": [float(x.min()) - 1, -50.0, float(x.min()) + 1, 50.0]})
    for of_truth in (None, truth):
        whole, part = (evaluate_map(m, survey, truth=of_truth) for m in (first, cut))
        assert whole.signs.recall < 1 and part.signs.recall == 1
        assert part.signs.observable == 1
        assert whole.lanes is not None and part.lanes is not None
        assert part.lanes.seen_length_m < min(10, whole.lanes.seen_length_m)


def test_another_origin_is_refused(build, simulated):
    true, _, survey, _ = simulated
    for origin in (Origin(32.9 + 2e-9, -117.2, 120.0), Origin(32.9, -117.2, 120.002)):
        with pytest.raises(ValueError, match="origin"):
            evaluate_map(replace(build.hd_map(true), origin=origin), survey)
    near = Origin(32.9 + 5e-10, -117.2, 120.0005)
    assert evaluate_map(replace(build.hd_map(true), origin=near), survey).signs.recall == 1


def test_progress_scalars_leave_out_what_is_unknown(build, simulated):
    true, lines, survey, _ = simulated
    moved, asked = build.moved(true, (0.1, 0, 0)), against(survey)
    scalars = progress_scalars(moved, asked, lanes=build.lanes(lines))
    assert scalars["error/corner_m"] == pytest.approx(0.1)
    assert scalars["error/lane_recall"] == 1
    nothing = true[torch.zeros(0, dtype=torch.int64)]
    assert "error/corner_m" not in progress_scalars(nothing, asked)


def test_a_tag_and_a_figure_of_one_name_are_one_number(build, simulated):
    true, lines, survey, truth = simulated
    # One sign that nobody saw, and one that pins the map: neither is asked for.
    unseen = replace(truth, journeys=tuple(_without_sign(t, 2) for t in truth.journeys))
    generator = torch.Generator().manual_seed(1)
    noise = 0.1 * torch.randn(2, 3, generator=generator, dtype=torch.float64)
    hd_map = build.hd_map(build.moved(true[torch.arange(2)], noise), build.lanes([lines[0] + 0.1]))
    for area in (None, [30.0, -50.0, 70.0, 50.0]):
        provenance = {} if area is None else {"bbox": area}
        figures = evaluate_map(
            replace(hd_map, provenance=provenance), survey, truth=unseen, control_ids=("s1",)
        )
        asked = against(
            survey, truth=unseen, control_ids=("s1",), area=None if area is None else Area(*area)
        )
        signs, found = figures.signs, figures.lanes
        assert found is not None and signs.observable == 1
        assert progress_scalars(hd_map.signs, asked, lanes=hd_map.lanes) == pytest.approx(
            {
                "error/corner_m": signs.absolute.total.mean,
                "error/corner_horizontal_m": signs.absolute.horizontal.mean,
                "error/corner_vertical_m": signs.absolute.vertical.mean,
                "error/center_m": signs.absolute_center.total.mean,
                "error/normal_deg": signs.normal_deg.mean,
                "error/sign_recall": signs.recall,
                "error/sign_precision": signs.precision,
                "error/lane_lateral_m": found.lateral.mean,
                "error/lane_lateral_without_shift_m": found.lateral_without_shift.mean,
                "error/lane_recall": found.recall,
            }
        )


def _without_sign(truth: JourneyTruth, sign: int) -> JourneyTruth:
    return replace(truth, sign=torch.where(truth.sign == sign, -1, truth.sign))


def test_real_surveyed_centres_are_measured_by_centre(build, real_data):
    survey = read_survey(real_data("kitti-signs/kitti-00") / "survey")
    assert not survey.signs.has_corners.any()
    signs = build.signs(survey.signs.center_world + torch.tensor([0.1, 0.0, 0.0]))
    figures = evaluate_map(
        replace(build.hd_map(signs), origin=survey.origin), survey, gate_m=2.0
    ).as_dict()
    assert figures["signs"]["recall"] == figures["signs"]["precision"] == 1
    assert figures["signs"]["absolute"]["total"]["count"] == 0
    # The shift is given in single precision.
    assert figures["signs"]["absolute_center"]["total"]["mean"] == pytest.approx(0.1, abs=1e-6)
    assert figures["lanes"] is None
