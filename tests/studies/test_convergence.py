from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from worlds.studied import rows, work

from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.studies import convergence
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


@pytest.fixture
def corners() -> CornerObservations:
    """Four corners of each of 2000 detections, ten metres away."""
    rows = 8000
    detection = 2 * (torch.arange(rows) // 4)
    matrix = torch.eye(3, dtype=torch.float64).repeat(rows, 1, 1)
    others = {f.name: torch.zeros(rows, dtype=torch.float64) for f in fields(CornerObservations)}
    others |= dict.fromkeys(("frame", "sign", "lens", "journey"), detection)
    others |= {name: torch.zeros(rows, 2).double() for name in ("template", "px", "ideal", "bend")}
    return CornerObservations(**{**others, "detection": detection, "matrix": matrix})


def test_outliers_are_whole_detections_10_to_40_pixels_off(corners: CornerObservations, generator):
    far, left = convergence.outliers(corners, generator)
    # The projection of the optical axis is the pixel by which a detection was moved.
    push = (corners.matrix - far.matrix)[:, :2, 2]
    assert torch.equal(far.px - corners.px, push)
    length = push.norm(dim=1)
    is_far = length > 0
    assert (push.view(-1, 4, 2) == push.view(-1, 4, 2)[:, :1]).all()
    assert is_far.double().mean() == pytest.approx(convergence.OUTLIERS, abs=0.012)
    low, high = convergence.OUTLIER_PX
    assert low <= length[is_far].min() and length[is_far].max() <= high
    assert torch.equal(left.detection, corners.detection[~is_far])


def test_a_row_is_told_in_millimetres(settings: Settings, folder: StudyFolder):
    first, *_ = work(convergence, settings)
    moved = {"mean": 0.001, "p95": 0.002, "max": 0.003}
    names = ("outliers", "left_out", "between", "far")
    result = dict.fromkeys(names, moved) | {"far_pose_m": 0.004, "finite": True, "seconds": 1.0}
    folder.write_result(first.key, result)
    chapter = convergence.chapter(settings, folder)
    assert rows(chapter.tables[0])[0] == pytest.approx((0, 1, 2, 3, 1, 3, 1, 3, 1, 3, 4))
    assert chapter.text[0].endswith("finite: yes.")
