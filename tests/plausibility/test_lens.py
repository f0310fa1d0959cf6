"""Pixels with and without the lens of their rig, in drives whose poses drift and whose detections are noisy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.optim.band_cholesky import BandFactor, BandInverse
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.plausibility.lens import (
    _undistorted,
    _without_lens,
    lens_findings,
    own_missing_lens,
)
from crowdmap_torch.plausibility.missing_lens import LensLimits, MissingLens, missing_lens
from crowdmap_torch.simulate.dataset import write_dataset
from crowdmap_torch.soak.spoiled import relensed, spoiled
from crowdmap_torch.soak.varied import winding_street
from crowdmap_torch.tables import Journey, Tracklets
from crowdmap_torch.tracking.signs import associate_signs

MILD = [-0.08, 0.01, 0.0, 0.0]
CONFIG = MapperConfig()


def tracked(journeys: Sequence[Journey]) -> list[Tracklets]:
    return [associate_signs(j, CONFIG.positioning, CONFIG.sign_association) for j in journeys]


def found_in(
    journeys: Sequence[Journey], tracklets: Sequence[Tracklets]
) -> list[tuple[str, Finding]]:
    pairs = zip(journeys, tracklets, strict=True)
    own = [own_missing_lens(journey, tracks, CONFIG.positioning) for journey, tracks in pairs]
    return lens_findings(journeys, own)


def found(folder: Path) -> list[tuple[str, Finding]]:
    journeys = load_dataset(folder).journeys
    return found_in(journeys, tracked(journeys))


def without_lens(camera: Camera) -> Camera:
    return replace(camera, model="brown_conrady", distortion=camera.K.new_zeros(0))


def missing(journey: Journey, tracks: Tracklets) -> MissingLens:
    other = without_lens(journey.rig.camera)
    result = missing_lens(journey, tracks, other, CONFIG.positioning, LensLimits())
    assert result is not None
    return result


def test_a_mild_lens_is_told_from_none(winding_folder: Path, tmp_path: Path) -> None:
    raw = relensed(winding_folder, tmp_path / "raw", MILD)
    journeys = load_dataset(raw).journeys[:2]
    assert found_in(journeys, tracked(journeys)) == []
    named = found(spoiled(raw, tmp_path / "bad", "undistorted"))
    assert {finding.kind for _, finding in named} == {"undistorted"}
    assert len(named) == 4


def test_raw_pixels_of_a_rig_without_distortion_are_named_with_the_lens(
    winding_folder: Path, tmp_path: Path
) -> None:
    named = found(spoiled(winding_folder, tmp_path / "bad", "no-lens"))
    assert {finding.kind for _, finding in named} == {"no-lens"}
    # The simulator's lens: -0.12, within a tenth.
    k1 = float(named[0][1].evidence.split("k1 = ")[1].split()[0])
    assert -0.14 <= k1 <= -0.09


def test_undistorted_pixels_of_a_rig_without_distortion_are_right(
    spoil: Callable[[str], Path], tmp_path: Path
) -> None:
    bare = spoiled(spoil("undistorted"), tmp_path / "bare", "no-lens")
    assert found(bare) == []


def test_noise_of_pixels_does_not_make_a_lens_stronger(good: Path) -> None:
    # Errors of undistorted pixels would: a share of 0.1 of a lens of -0.12 for each pixel of noise.
    journeys = load_dataset(good).journeys
    generator = torch.Generator().manual_seed(0)
    for journey, tracks in zip(journeys, tracked(journeys), strict=True):
        px = journey.signs.corners_px
        noisy = px + 1.5 * torch.randn(px.shape, generator=generator, dtype=px.dtype)
        result = missing(replace(journey, signs=replace(journey.signs, corners_px=noisy)), tracks)
        assert abs(result.share) < max(0.25, 4 * result.sigma)


def test_noise_of_poses_is_no_lens(tmp_path: Path) -> None:
    street = winding_street(journeys=3)
    noisy = replace(
        street,
        rig=replace(street.rig, camera="pinhole"),
        positioning=replace(street.positioning, white_rot_deg=0.2),
        signs=replace(street.signs, range_m=(12.0, 30.0)),
    )
    write_dataset(noisy, tmp_path / "noisy")
    journeys = load_dataset(tmp_path / "noisy").journeys

    drives = zip(journeys, tracked(journeys), strict=True)
    own = [own_missing_lens(*drive, CONFIG.positioning) for drive in drives]
    expected = [replace(one, as_detected=None) for one in own if one is not None]
    limits = LensLimits(sure=2.0)
    # By where signs are expected alone it is a barrel.
    assert [finding.kind for _, finding in lens_findings(journeys, expected, limits)] == 3 * [
        "no-lens"
    ]
    assert lens_findings(journeys, own, limits) == []


def test_which_sign_is_numbered_first_costs_nothing(
    good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 113 s and 6.8 GB of a drive of 8 km whose first number was that of a sign at its end.
    reaches = []
    of = BandInverse.of

    def counted(factor: BandFactor, reach: int) -> BandInverse:
        reaches.append(reach)
        return of(factor, reach)

    monkeypatch.setattr(BandInverse, "of", counted)
    (journey,) = load_dataset(good).journeys[:1]
    (tracks,) = tracked([journey])
    backward = torch.where(tracks.label < 0, tracks.label, tracks.count - 1 - tracks.label)
    there, back = (missing(journey, replace(tracks, label=x)) for x in (tracks.label, backward))
    assert back.share == pytest.approx(there.share, abs=1e-6)
    assert back.sigma == pytest.approx(there.sigma, rel=1e-4)
    assert max(reaches) < 2 * min(reaches)


def test_drives_that_tell_nothing_are_passed_over(good: Path) -> None:
    journeys = load_dataset(good).journeys
    nothing = [Tracklets(torch.full_like(j.signs.frame, -1), 0) for j in journeys]
    assert found_in(journeys, nothing) == []
    assert lens_findings([], []) == []


def test_drives_that_differ_as_drives_do_decide_together(good: Path) -> None:
    journeys = 2 * load_dataset(good).journeys
    bare = [
        replace(j, journey_id=str(k), rig=replace(j.rig, camera=without_lens(j.rig.camera)))
        for k, j in enumerate(journeys)
    ]
    # Of a highway and a narrow camera: nearly six of their own sigmas together, over four of what drives differ by.
    said = [(0.81, 0.26), (1.06, 0.28), (1.55, 0.42), (0.43, 0.39)]
    named = lens_findings(bare, [MissingLens(*one) for one in said])
    assert {finding.kind for _, finding in named} == {"no-lens"}


@pytest.mark.parametrize("shares", [(0.0, 1.0), (1.0, -1.0)])
def test_drives_that_contradict_each_other_do_not_decide(
    shares: tuple[float, ...], good: Path
) -> None:
    journeys = load_dataset(good).journeys
    assert lens_findings(journeys, [MissingLens(share, 0.05) for share in shares]) == []


def test_a_lens_is_named_unless_a_lever_explains_more() -> None:
    # As drives of a block show it by night: a lever of 1.1 m, 18 standard deviations, looks like two thirds of a lens.
    limits = LensLimits()
    by_lever, by_lens = [MissingLens(0.66, 0.07)] * 4, [MissingLens(1.0, 0.06)] * 4
    for judge in (_undistorted, _without_lens):
        assert judge(by_lever, limits, 0.0) is not None
        assert judge(by_lever, limits, 40.0) is None
        assert judge(by_lens, limits, 6.5) is not None
