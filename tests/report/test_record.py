from __future__ import annotations

import pytest
import torch

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.html import report_html
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.report.record import RunRecord, record_of
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.report.watch import Watch
from crowdmap_torch.tables import Dataset


@pytest.fixture(scope="module")
def made(tiny: Dataset, tiny_result: MapResult, tmp_path_factory) -> RunRecord:
    """Of the tiny dataset, without a survey."""
    with TensorBoardLog(tmp_path_factory.mktemp("log")) as log:
        watch = Watch(log, None, tiny_result.first.signs, tiny_result.first.lanes)
    return record_of(tiny, tiny_result, MapperConfig(), watch, Progress(), None, None, None, None)


def test_a_record_holds_every_journey_and_certain_signs_alone(
    made: RunRecord, tiny: Dataset, tiny_result: MapResult
):
    assert [j.journey_id for j in made.journeys] == [j.journey_id for j in tiny.journeys]
    assert [drive.journey_id for drive in made.drives] == [j.journey_id for j in tiny.journeys]
    assert (made.hd_map.signs.confidence >= MapperConfig().min_confidence).all()
    assert len(made.hd_map.signs) <= len(tiny_result.hd_map.signs)
    for drive, poses in zip(made.drives, tiny_result.poses, strict=True):
        assert torch.equal(drive.path_world, poses[:, :3, 3])


def test_eigenvalues_ascend_to_beyond_the_gap(made: RunRecord):
    assert made.spectra
    for spectrum in made.spectra:
        assert list(spectrum.eigenvalue) == sorted(spectrum.eigenvalue)
        assert spectrum.clusters <= len(spectrum.eigenvalue)


def test_a_run_without_a_survey_has_a_report(made: RunRecord):
    assert made.comparison is None and made.comparison_before is None
    page = report_html(made)
    assert made.title in page and 'id="errors"' not in page
