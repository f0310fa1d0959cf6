from __future__ import annotations

import math
from dataclasses import replace

import pytest
from worlds.studied import fill, rows, work

from crowdmap_torch.simulate.positioning import POSITIONING_PRESETS
from crowdmap_torch.studies import journeys
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_the_statistical_bound_falls_with_the_root_down_to_what_all_share():
    alone = [{"signs": {"absolute": {"total": {"mean": value}}}} for value in (0.4, 0.6)]
    bound = [journeys.statistical_bound(alone, "absolute.total", n, 0.0) for n in (1, 4, 25)]
    assert bound == pytest.approx([0.5, 0.25, 0.1])
    far = journeys.statistical_bound(alone, "absolute.total", 10**8, 0.17)
    assert far == pytest.approx(0.17, abs=1e-6)


def test_the_shared_bias_is_as_long_as_its_three_parts():
    shared = {"shared_bias_e_m": 0.2, "shared_bias_n_m": 0.3, "shared_bias_u_m": 0.6}
    positioning = replace(POSITIONING_PRESETS["paper"], **shared)
    assert journeys.shared_bias_m(positioning) == pytest.approx(0.7)


def test_curves_bounds_and_targets_are_those_of_the_results(
    settings: Settings, folder: StudyFolder
):
    fill(folder, work(journeys, settings))
    targets, curves, lanes = journeys.chapter(settings, folder).tables
    mean = {row[0]: row[2] for row in rows(targets)}
    assert mean["absolute error [m]"] == pytest.approx(0.2)
    assert mean["share taken off them"] == pytest.approx(0.5)
    by_count = {
        (row[0], row[1]): dict(zip(curves.columns, row, strict=True)) for row in rows(curves)
    }
    assert {count for count, _ in by_count} == set(settings.scale.counts)
    relative = by_count[3, "relative"]
    assert relative["ours [m]"] == pytest.approx(0.1)
    assert relative["bound"] == pytest.approx(0.1 / math.sqrt(3))
    assert {row[1] for row in rows(lanes)} == set(journeys.LANES)
