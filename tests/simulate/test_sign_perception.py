from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.simulate.dataset import DETECTION_PRESETS, SimulationConfig
from crowdmap_torch.simulate.rigs import RigConfig, build_rig
from crowdmap_torch.simulate.sign_detections import DAY, corner_sigma
from crowdmap_torch.simulate.sign_perception import detect_signs, jitters
from crowdmap_torch.simulate.vehicle import VehicleConfig, drive_through
from crowdmap_torch.simulate.worlds import WORLD_PRESETS

PERFECT = replace(
    DAY,
    pixel_noise_px=0.0,
    missed=0.0,
    occlusions=0.0,
    outliers=0.0,
    wrong_shape=0.0,
    duplicates=0.0,
    ghosts_per_frame=0.0,
    ghost_runs_per_frame=0.0,
    vehicle_signs_per_frame=0.0,
    wrong_code=0.0,
    null_code=0.0,
    track_switches=0.0,
    track_errors=0.0,
    null_track=0.0,
)


@pytest.fixture(scope="module")
def rig():
    return build_rig(RigConfig(), 0, np.random.default_rng(5))


@pytest.fixture(scope="module")
def drive(suburb, rig):
    return drive_through(suburb, rig, VehicleConfig(), np.random.default_rng(3))


def _detect(world, drive, rig, config, seed=0):
    rng = np.random.default_rng(seed)
    return detect_signs(world.signs, drive, rig.camera, config, rng, frame_rate_hz=15.0)


def _exact(world, drive, rig, rows):
    """The true corners of detections in pixels, and the detected ones in the same order."""
    true = rows.sign >= 0
    frame, sign = rows.frame[true], rows.sign[true]
    p_world = world.signs.corners()[sign]
    p_camera = (p_world - drive.p_world_camera[frame, None]) @ drive.R_world_camera[frame]
    px, _ = project(rig.camera, torch.from_numpy(p_camera))
    detected = torch.from_numpy(rows.corners_px[true])
    count = polygon.corner_count(torch.from_numpy(rows.shape[true]))
    shift, _ = polygon.best_shift(px, detected, count)
    return px.numpy(), polygon.roll(detected, shift, count).numpy(), shift.numpy(), p_camera


def test_a_perfect_detector_reports_the_projected_corners(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, PERFECT)
    px, detected, shift, p_camera = _exact(suburb, drive, rig, rows)
    np.testing.assert_allclose(detected, px, atol=1e-9)
    assert set(shift) == set(range(8))  # they start anywhere
    box = px.max(1) - px.min(1)
    assert box.max(-1).min() >= PERFECT.min_box_px
    centre = p_camera.mean(1)
    assert 11.5 < centre[:, 2].min() and centre[:, 2].max() < 80.5
    assert (rows.shape == suburb.signs.shape[rows.sign]).all()
    area = polygon.signed_area(
        torch.from_numpy(rows.corners_px), polygon.corner_mask(torch.from_numpy(rows.shape))
    )
    assert (area > 0).all()


def test_signs_are_seen_from_their_front_only(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, PERFECT)
    seen = np.unique(rows.sign)
    travel = suburb.road.tangent_frame(np.full(1, 250.0), np.zeros(1))[0, :, 0]
    faces_us = suburb.signs.normal @ travel < 0
    assert faces_us[seen].all()
    assert not faces_us.all()
    assert len(seen) > 0.9 * faces_us.sum()


def test_noise_has_the_stated_sigma_at_every_size(suburb, drive, rig):
    config = replace(PERFECT, pixel_noise_px=0.55)
    rows = _detect(suburb, drive, rig, config)
    px, detected, _, _ = _exact(suburb, drive, rig, rows)
    mask = polygon.corner_mask(torch.from_numpy(rows.shape)).numpy()
    sigma = corner_sigma((px.max(1) - px.min(1)).max(-1), config)
    scaled = ((detected - px) / sigma[:, None, None])[mask]
    # Some ten thousand numbers: 3 % is four sigma of their standard deviation.
    assert scaled.std() == pytest.approx(1.0, abs=0.03)
    assert 0.5 <= sigma.min() and sigma.max() <= 0.8


@pytest.mark.parametrize("preset", ["day", "night"])
def test_faults_come_as_often_as_asked_for(suburb, drive, rig, preset):
    config = replace(DETECTION_PRESETS[preset][0], occlusions=0.0)
    perfect = len(_detect(suburb, drive, rig, PERFECT))
    tables = [_detect(suburb, drive, rig, config, seed) for seed in range(8)]
    true = [rows.sign >= 0 for rows in tables]
    count = sum(t.sum() for t in true)
    # Wide bounds: a few hundred faults each, and duplicates come on top.
    expected = (1 - config.missed) * (1 + config.duplicates)
    assert count / (8 * perfect) == pytest.approx(expected, rel=0.03)
    outliers = sum(rows.is_outlier[t].sum() for rows, t in zip(tables, true, strict=True))
    assert outliers / count == pytest.approx(config.outliers + config.wrong_shape, rel=0.35)
    ghosts = sum((~t).sum() for t in true) / (8 * len(drive))
    assert 0.5 * config.ghosts_per_frame < ghosts < 4 * config.ghosts_per_frame
    for rows in tables:
        pairs = np.stack((rows.frame, rows.sign), axis=-1)[rows.sign >= 0]
        assert len(np.unique(pairs, axis=0)) < len(pairs) + 1
        size = [rig.camera.width - 0.5, rig.camera.height - 0.5]
        mask = polygon.corner_mask(torch.from_numpy(rows.shape)).numpy()
        assert (rows.corners_px[mask] > -0.5).all() and (rows.corners_px[mask] < size).all()
        assert (np.diff(rows.frame) >= 0).all()
        assert (0 <= rows.score).all() and (rows.score <= 1).all()


def test_occlusion_hides_a_sign_for_a_while(suburb, drive, rig):
    hidden = _detect(suburb, drive, rig, replace(PERFECT, occlusions=1.0))
    perfect = _detect(suburb, drive, rig, PERFECT)
    lost = len(perfect) - len(hidden)
    signs = len(np.unique(perfect.sign))
    # Bursts of 0.3 to 1.5 s, some of them cut short by the end of the view.
    assert 3 * signs < lost < 23 * signs


def test_track_numbers_are_mostly_right_and_sometimes_wrong(suburb, drive, rig):
    perfect = _detect(suburb, drive, rig, PERFECT)
    for track in np.unique(perfect.track):
        assert len(np.unique(perfect.sign[perfect.track == track])) == 1
    rows = _detect(suburb, drive, rig, DAY)
    rows = rows[(rows.track >= 0) & (rows.sign >= 0)]
    most = {t: np.bincount(rows.sign[rows.track == t]).argmax() for t in np.unique(rows.track)}
    right = np.mean([most[t] == s for t, s in zip(rows.track, rows.sign, strict=True)])
    assert 0.95 < right < 1.0


def test_detections_do_not_depend_on_how_frames_are_cut_into_chunks(
    suburb, drive, rig, monkeypatch
):
    whole = _detect(suburb, drive, rig, DAY)
    monkeypatch.setattr("crowdmap_torch.simulate.sign_perception._CHUNK_FRAMES", 100)
    pieces = _detect(suburb, drive, rig, DAY)
    np.testing.assert_array_equal(whole.corners_px, pieces.corners_px)


def test_default_detection_is_day():
    assert SimulationConfig().signs == DETECTION_PRESETS["day"][0]
    assert DETECTION_PRESETS["night"][0].missed == 0.35
    assert set(WORLD_PRESETS) == {"street", "suburb", "highway", "motorway", "hills", "block"}


def test_jitter_has_unit_variance_and_is_forgotten_in_its_time():
    count, dt, memory = 4000, 0.1, 0.3
    t, sign = np.tile(np.arange(7) * dt, count), np.repeat(np.arange(count), 7)
    mixed = np.random.default_rng(1).permutation(len(t))
    found = np.empty((len(t), 3))
    found[mixed] = jitters(t[mixed], sign[mixed], memory, np.random.default_rng(0))
    found = found.reshape(count, 7, 3)
    # 12,000 pairs: a correlation is known to 0.01.
    for lag in (0, 1, 3, 6):
        product = (found[:, 0] * found[:, lag]).mean()
        assert product == pytest.approx(np.exp(-lag * dt / memory), abs=0.04)
    assert abs((found[:-1, 3] * found[1:, 3]).mean()) < 0.04
    assert abs((found[..., 0] * found[..., 1]).mean()) < 0.04


def test_jitter_moves_and_scales_all_corners_of_a_detection_alike(suburb, drive, rig):
    steady = _detect(suburb, drive, rig, PERFECT)
    shifted = _detect(suburb, drive, rig, replace(PERFECT, jitter_px=0.7))
    assert np.array_equal(steady.frame, shifted.frame)
    shift = shifted.corners_px - steady.corners_px
    assert np.ptp(shift, axis=1).max() < 1e-9
    # Some 60 signs a second or two long: a few hundred independent draws.
    assert shift[:, 0].std() == pytest.approx(0.7, rel=0.2)
    scaled = _detect(suburb, drive, rig, replace(PERFECT, jitter_scale=0.01))
    growth = np.ptp(scaled.corners_px, axis=1) / np.ptp(steady.corners_px, axis=1) - 1
    assert np.abs(growth[:, 0] - growth[:, 1]).max() < 1e-9
    assert growth[:, 0].std() == pytest.approx(0.01, rel=0.25)


def test_jitter_changes_nothing_else_that_is_drawn(suburb, drive, rig):
    steady = _detect(suburb, drive, rig, DAY)
    jittering = _detect(suburb, drive, rig, replace(DAY, jitter_px=1e-6))
    assert np.array_equal(steady.code, jittering.code)
    assert np.abs(steady.corners_px - jittering.corners_px).max() < 1e-4
