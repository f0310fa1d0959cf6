from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crowdmap_torch.geometry import polygon
from crowdmap_torch.simulate.rigs import RigConfig, build_rig
from crowdmap_torch.simulate.sign_detections import DAY
from crowdmap_torch.simulate.sign_faults import ghosts, with_outliers, with_wrong_shapes

CORNERS = polygon.CORNER_COUNT.numpy()
COUNT = 2000


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def shape(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, len(polygon.SHAPES), COUNT)


@pytest.fixture
def corners(rng: np.random.Generator) -> np.ndarray:
    """Corners anywhere in boxes of some thirty pixels; slots past the last one repeat nothing."""
    return rng.uniform(100, 130, (COUNT, 8, 2))


def test_a_wrong_shape_is_another_one_in_the_same_box(shape, corners, rng):
    is_wrong = np.arange(COUNT) % 2 == 0
    other, moved = with_wrong_shapes(shape, corners, is_wrong, rng)
    assert (other[is_wrong] != shape[is_wrong]).all()
    assert np.array_equal(other[~is_wrong], shape[~is_wrong])
    assert np.array_equal(moved[~is_wrong], corners[~is_wrong])
    middles = [(c.min(1) + c.max(1)) / 2 for c in (moved[is_wrong], corners[is_wrong])]
    assert middles[0] == pytest.approx(middles[1])


def test_an_outlier_is_one_corner_or_all_of_them_as_far_off_as_asked(shape, corners, rng):
    is_far = np.arange(COUNT) % 2 == 0
    moved = with_outliers(corners, shape, is_far, DAY, rng)
    away = np.linalg.norm(moved - corners, axis=-1)
    assert (away[~is_far] == 0).all()
    length = away[is_far].max(-1)
    low, high = DAY.outlier_px
    assert low <= length.min() and length.max() <= high
    moved_corners = (away[is_far] > 0).sum(-1)
    assert set(moved_corners) == {1, 8}
    assert (moved_corners == 1).mean() == pytest.approx(0.5, abs=0.06)
    # The single corner is one that the shape has.
    one = away[is_far].argmax(-1)[moved_corners == 1]
    assert (one < CORNERS[shape[is_far]][moved_corners == 1]).all()


def test_ghosts_come_as_often_as_asked_and_show_no_sign(rng):
    camera = build_rig(RigConfig(), 0, rng).camera
    frames = 20_000
    config = replace(DAY, ghost_runs_per_frame=0.0, vehicle_signs_per_frame=0.0)
    single = ghosts(frames, camera, config, rng, last_track=5)
    assert len(single) / frames == pytest.approx(DAY.ghosts_per_frame, rel=0.2)
    assert (single.sign == -1).all() and (single.track == -1).all() and single.is_outlier.all()
    runs = ghosts(
        frames, camera, replace(config, ghosts_per_frame=0, ghost_runs_per_frame=0.01), rng, 5
    )
    assert runs.track.min() > 5 and runs.frame.max() < frames
    _, lasts = np.unique(runs.track, return_counts=True)
    # Those at the end of the drive are cut off.
    assert lasts.max() <= 8 and (lasts >= 3).mean() > 0.99
