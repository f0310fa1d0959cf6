from __future__ import annotations

import math

import pytest
from scipy.stats import chi2
from worlds.studied import figures, fill, measured, rows, work

from crowdmap_torch.studies import honesty
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_coverage_is_that_of_all_signs_together(settings: Settings, folder: StudyFolder):
    def result(task) -> dict:
        adjusted = figures(0.1, 0.2)
        signs, coverage = ((30, 0.9), (10, 0.5))[task.simulation.seed]
        adjusted["uncertainty"] |= {"signs": signs, "coverage": coverage}
        return measured(map=adjusted)

    fill(folder, work(honesty, settings), result)
    table, by_set = honesty.chapter(settings, folder).tables
    found = {row[0]: row[1:] for row in rows(table)}
    mean, asked = found["sign centres inside their 95 % ellipsoid [%]"]
    assert mean == pytest.approx(80)
    assert asked == "92 to 98 %"
    low, high = chi2.ppf((0.025, 0.975), 6) / 2
    shared = found["the shared part's, mean over the data sets"]
    assert shared == (pytest.approx(2.0), f"{low:.2f} to {high:.2f}")
    assert [row[:3] for row in rows(by_set)] == [(0, 30, 90.0), (1, 10, 50.0)]


def test_a_chapter_of_nothing_is_there(settings: Settings, folder: StudyFolder):
    table, by_set = honesty.chapter(settings, folder).tables
    assert all(math.isnan(row[1]) for row in rows(table))
    assert rows(by_set) == []
