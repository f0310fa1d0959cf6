from __future__ import annotations

from pathlib import Path

import pytest
import torch
from worlds.nested import flat

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.studies.measure import (
    Drives,
    averaged_signs,
    load_drives,
    measure_journey,
    measure_map,
    observable_rows,
    shared_part,
    spread_signs,
    true_signs,
)
from crowdmap_torch.tables import Survey


@pytest.fixture(scope="module")
def drives(tiny_folder: Path) -> Drives:
    return load_drives(tiny_folder)


def test_the_measured_map_is_that_of_the_mapper(
    drives: Drives, tiny_result: MapResult, tiny_survey: Survey, tiny_truth: Truth
):
    config = MapperConfig()
    measured = measure_map(drives, tiny_result.journey_maps, config, adjusted=True)
    for name, hd_map in (("map", tiny_result.hd_map), ("heads", tiny_result.map_clusters)):
        kept = certain_part(hd_map, config.min_confidence)
        expected = evaluate_map(kept, tiny_survey, truth=tiny_truth).as_dict()
        for part in ("signs", "lanes", "oracle"):
            # Sums in another order differ in the last bits.
            assert flat(measured[name][part]) == pytest.approx(flat(expected[part]), rel=1e-6)
    assert measured["map"]["association"]["data_loss"] is not None
    assert measured["outlier_journeys"] == [] and measured["bad"] == {}
    assert measured["clusters"]["signs"] == sum(len(m.signs) for m in tiny_result.journey_maps)
    assert measured["seconds"]["adjusted"] > 0


def test_heads_alone_are_measured_without_adjustment(drives: Drives, tiny_result: MapResult):
    measured = measure_map(drives, tiny_result.journey_maps, MapperConfig(), adjusted=False)
    assert "map" not in measured and "adjusted" not in measured["seconds"]


def test_control_signs_pin_the_map_and_do_not_count(drives: Drives, tiny_result: MapResult):
    config, maps = MapperConfig(), tiny_result.journey_maps
    free = measure_map(drives, maps, config, adjusted=True)
    pinned = measure_map(drives, maps, config, adjusted=True, control=2)
    assert pinned["control_points"] == pinned["map"]["control_signs"] == 2
    observable = free["map"]["signs"]["observable"]
    assert pinned["map"]["signs"]["observable"] == observable - 2
    free_m, pinned_m = (m["map"]["signs"]["absolute"]["total"]["mean"] for m in (free, pinned))
    assert pinned_m < 0.5 * free_m


def test_fewer_journeys_than_count_must_all_have_seen_a_sign(drives: Drives):
    first, second = drives.select([0]), drives.select([1])
    both = observable_rows(drives.select([0, 1]))
    assert bool(both.any())
    assert torch.equal(both, observable_rows(first) & observable_rows(second))


def test_a_map_of_one_journey_has_figures(drives: Drives, tiny_result: MapResult):
    one = drives.select([0])
    measured = measure_map(one, tiny_result.journey_maps[:1], MapperConfig(), adjusted=False)
    assert measured["heads"]["signs"]["observable"] == int(observable_rows(one).sum()) > 0
    assert measured["heads"]["signs"]["absolute"]["total"]["mean"] > 0


def test_true_signs_are_those_nearby(drives: Drives, tiny_result: MapResult):
    made, truth = tiny_result.journey_maps[0], drives.truth.journeys[0]
    true = true_signs(made, truth)
    known = true >= 0
    assert int(known.sum()) >= 3
    away = made.signs[known].center_world - drives.survey.signs.center_world[true[known]]
    # A journey's own signs are off by its bias, about half a metre.
    assert float(away.norm(dim=1).max()) < 2.5


def test_an_average_of_journeys_errs_less_than_they_do(drives: Drives, tiny_result: MapResult):
    maps = tiny_result.journey_maps
    average = averaged_signs(drives, maps, observable_rows(drives))
    assert average.recall == 1 and average.precision == 1
    alone = [measure_journey(drives, row, made) for row, made in enumerate(maps)]
    mean = sum(one["signs"]["absolute"]["total"]["mean"] for one in alone) / len(alone)
    assert average.absolute.total.mean < mean
    assert all(one["clean"]["corner"]["total"]["mean"] < 0.5 for one in alone)


def test_spread_signs_are_far_from_each_other(tiny_survey: Survey):
    among = torch.ones(len(tiny_survey.signs), dtype=torch.bool)
    among[0] = False
    two = spread_signs(tiny_survey, among, 2)
    center = tiny_survey.signs.center_world
    apart = torch.cdist(center[among], center[among]).max()
    # The first is the farthest from the middle: a pair of these is nearly the farthest there is.
    assert float((center[two[0]] - center[two[1]]).norm()) > 0.8 * float(apart)
    every = spread_signs(tiny_survey, among, 1000)
    assert sorted(every.tolist()) == torch.nonzero(among)[:, 0].tolist()
    assert len(spread_signs(tiny_survey, among, 0)) == 0


def test_what_all_share_is_judged_by_the_sigmas_it_was_drawn_from(drives: Drives):
    """Three journeys of 120 m: 0.78 of the variance of a drift that forgets itself over 150 m stay in its mean."""
    exact = torch.diag(torch.tensor([0.139, 0.139, 0.225], dtype=torch.float64)) / 3
    found = shared_part(drives, PositioningConfig(), exact)
    assert found["expected_nees"] == pytest.approx(3.0, rel=0.05)
    assert shared_part(drives, PositioningConfig(), 2 * exact)["expected_nees"] == pytest.approx(
        found["expected_nees"] / 2
    )
    error = torch.stack([t.mean_error_m for t in drives.truth.journeys]).mean(0)
    assert found["drawn_nees"] == pytest.approx(
        float((error.square() / exact.diagonal()).sum()), rel=0.1
    )
