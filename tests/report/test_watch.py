from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.evaluate import against
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.report.watch import Residuals, Watch, corner_residuals
from crowdmap_torch.tables import Dataset, Survey


@pytest.fixture(scope="module")
def watched(tiny: Dataset, tiny_result: MapResult, tiny_survey: Survey, tmp_path_factory):
    """Three steps of an adjustment, every second one looked at; and where they were logged."""
    folder: Path = tmp_path_factory.mktemp("log")
    first = tiny_result.first
    bundle = mapper.build_bundle(tiny.journeys, tiny_result.journey_maps, first, MapperConfig())
    state = adjust.start(bundle)
    with TensorBoardLog(folder) as log:
        watch = Watch(log, against(tiny_survey), first.signs, first.lanes, every=2)
        watch.start(bundle, mapper.clusters_map(tiny, first))
        for number, after, seen in adjust.steps(bundle, state):
            watch.step(number, after, bundle, seen())
            if number == 2:
                break
        watch.finish(bundle, tiny_result.hd_map)
    size = {"scalars": 0, "histograms": 1, "images": 1}
    return watch, bundle, EventAccumulator(str(folder), size_guidance=size).Reload()


def test_every_step_is_kept_and_logged_with_its_cost(watched):
    watch, _, events = watched
    assert [i.number for i in watch.iterations] == [1, 2, 3]
    logged = events.Scalars("cost/total")
    assert [event.step for event in logged] == [1, 2, 3]
    # Events are of single precision.
    assert [e.value for e in logged] == pytest.approx([i.total for i in watch.iterations], rel=1e-6)


def test_a_step_ends_below_where_it_began_in_its_own_scales(watched):
    watch, _, _ = watched
    for step in watch.iterations:
        assert step.cost_before > step.total if step.accepted else step.cost_before == step.total
        assert set(step.scale) == {
            *("sign_px", "lane_px", "lane_correlation", "lasting_px", "lasting_size")
        }
    for step, following in pairwise(watch.iterations):
        assert step.cost_after == following.cost_before
    # Scales narrow after the first step: the same errors are more of them.
    first = watch.iterations[0]
    assert first.cost_after > first.total
    assert first.scale["sign_px"] > watch.iterations[-1].scale["sign_px"]
    # Where another watch goes on, the next step begins where this one ended.
    other = Watch(watch._log, None, watch._signs, watch._lanes)
    other.go_on(Residuals({}, 1.0), watch.course)
    assert other._cost == watch.iterations[-1].cost_after


def test_errors_and_residuals_are_those_of_the_steps_looked_at(watched):
    watch, _, events = watched
    assert [bool(i.errors) for i in watch.iterations] == [True, False, True]
    assert "residual/sign_reprojection" in events.Tags()["histograms"]
    # Before the first step, and after the first and the third.
    assert [e.step for e in events.Scalars("error/corner_m")] == [0, 1, 3]


def test_corner_residuals_are_in_pixels_and_smaller_after_the_adjustment(watched):
    watch, bundle, _ = watched
    before, after = watch.residual_px["cluster heads"], watch.residual_px["adjusted map"]
    assert len(before) == len(after) == len(bundle.corners)
    assert (after >= 0).all() and after.median() < before.median()
    assert torch.equal(corner_residuals(bundle).norm(dim=-1), after)


def test_map_and_residuals_are_drawn_before_and_after(watched):
    _, bundle, events = watched
    cameras = [f"residual/over_image_{k}" for k in range(len(bundle.lenses))]
    assert set(events.Tags()["images"]) == {
        "map/before",
        "map/after",
        "residual/by_stage",
        *cameras,
    }
