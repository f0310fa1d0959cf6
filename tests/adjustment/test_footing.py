"""An adjustment that begins again: it stands where the one before ended, and has little left to do."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.split_landmarks import with_a_split_sign, with_split_lanes

from crowdmap_torch.adjustment import adjust, bundle_terms
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.bundle_terms import _NEW_REACH
from crowdmap_torch.adjustment.footing import Footing, footing_of
from crowdmap_torch.adjustment.steps import adjust_step
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_lanes.joined_anew import share_twice
from crowdmap_torch.crowd_signs.duplicates import DuplicateSignConfig
from crowdmap_torch.geometry import se3
from crowdmap_torch.mapper import (
    FirstMap,
    MapResult,
    adjusted_map,
    build_bundle,
    finish_map,
    made_anew,
)
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.report.summaries import counts_of
from crowdmap_torch.tables import Dataset

WANDERING = PositioningNoise(wander_length_m=200.0)
"""As if a drive of this length were a long one."""
STEADY = PositioningNoise(wander_sigma_m=0.0)
GONE = "signs joined or gone after the adjustment"


def built(
    tiny: Dataset, tiny_result: MapResult, first: FirstMap, told: PositioningNoise | None = None
) -> Bundle:
    """`told`: what the crowd's signs tell of positioning."""
    if told is not None:
        first = replace(first, crowd=replace(first.crowd, positioning=told))
    return build_bundle(tiny.journeys, tiny_result.journey_maps, first, MapperConfig())


@pytest.fixture(scope="module")
def ended(tiny: Dataset, tiny_result: MapResult) -> Bundle:
    """The first adjustment, at its end."""
    bundle = built(tiny, tiny_result, tiny_result.first)
    adjust.adjust(bundle)
    return bundle


def anew(tiny: Dataset, first: FirstMap, bundle: Bundle) -> FirstMap:
    """The map to begin again with where a bundle stands, its signs those of before."""
    signs, lanes = adjust.read_map(bundle, first.signs, first.lanes)
    poses = adjust.read_poses(bundle, tiny.journeys)
    drifts = tuple(map(se3.local, (journey.T_world_camera for journey in tiny.journeys), poses))
    return replace(first, signs=signs, lanes=lanes, drifts=drifts, footing=footing_of(bundle))


def test_it_stands_where_the_other_one_ended(tiny, tiny_result: MapResult, ended: Bundle):
    again = built(tiny, tiny_result, anew(tiny, tiny_result.first, ended))
    for name, value in ended.values().items():
        assert torch.allclose(again.values()[name], value, atol=1e-9), name
    for name in ("scale", "lasting", "prior_scale", "white_scale", "calibration_scale"):
        assert torch.equal(getattr(again, name), getattr(ended, name)), name
    # They may be judged once more.
    assert int(again.judged) == 1 and torch.equal(again.given_up, ended.given_up)


def without_first(ended: Bundle) -> Footing:
    """As if nobody had seen the first sign before."""
    footing = footing_of(ended)
    seen = footing.seen.clone()
    seen[ended.corners.detection[ended.corners.sign == 0]] = False
    return replace(footing, seen=seen)


def test_detections_that_are_new_tell_nothing_of_what_lasts_until_they_are_judged(
    tiny, tiny_result: MapResult, ended: Bundle
):
    first = anew(tiny, tiny_result.first, ended)
    assert not built(tiny, tiny_result, first).unjudged.any()
    new = built(tiny, tiny_result, replace(first, footing=without_first(ended)))
    of_first = ended.corners.detection[ended.corners.sign == 0].unique()
    assert torch.equal(torch.nonzero(new.unjudged)[:, 0], of_first)
    # Outlines of that sign tremble by many pixels for a while, or do not.
    told = []
    for bundle, there in ((ended, True), (new, True), (new, False)):
        rows, innovation = bundle.corners, torch.zeros_like(ended.innovation)
        error = torch.zeros_like(rows.px)
        if there:
            error[rows.sign == 0] = 20.0
            of_sign = bundle.detections.mean((rows.sign == 0).double()[:, None])[:, 0] == 1
            innovation[of_sign] = innovation.new_tensor([400.0, 1.0, 0.0])
        seen, _ = bundle._seen_lasting(error, innovation)
        told.append((float(seen.lasting.of_many[0]), float(seen.share)))
    assert told[0][0] > 1.0 and told[1] == told[2]
    # That is no judgement of the others, but what poses tell is asked anew.
    before = new.scales()
    new.judge(new.backend().assemble(new.problem(), new.values()))
    assert int(new.judged) == 1 and not new.unjudged.any()
    assert not torch.equal(new.scales(), before)


def test_noise_waits_until_detections_that_are_new_were_judged_two_steps_later(
    tiny, tiny_result: MapResult, ended: Bundle
):
    """Those of a sign that comes in show something else in every other frame: poses would be made to tremble."""
    first = anew(tiny, tiny_result.first, ended)
    bundle = built(tiny, tiny_result, replace(first, footing=without_first(ended)))
    new = bundle.unjudged.clone()
    rows = bundle.corners
    away = torch.where((rows.sign == 0) & (rows.frame % 2 == 0), 30.0, 0.0).to(rows.px)
    shift = torch.eye(3).to(rows.px).repeat(len(rows), 1, 1)
    shift[:, 0, 2] = away
    rows.matrix.copy_(shift @ rows.matrix)
    names = ("prior_scale", "white_scale", "lasting", "lasting_each", "share_there", "told_at")
    before = {name: getattr(bundle, name).clone() for name in names}
    state, backend = adjust.start(bundle), bundle.backend()
    for step in (1, 2, 3):
        state, finished = adjust_step(bundle, state, backend)
        assert not finished
        assert bool(bundle.unjudged.any()) == (step < 2)
        if step == 1:
            for name in names:
                assert torch.equal(getattr(bundle, name).nan_to_num(), before[name].nan_to_num())
    # By the noise that was known they have no say.
    assert bundle.given_up[new].double().mean() > 0.3
    assert not torch.equal(bundle.told_at.nan_to_num(), before["told_at"].nan_to_num())


@pytest.mark.parametrize("reach", [_NEW_REACH, 1.0], ids=["new ones have a say", "they have none"])
def test_a_sign_that_is_new_goes_where_it_is_seen_though_noise_is_known_to_be_small(
    tiny, tiny_result: MapResult, ended: Bundle, monkeypatch: pytest.MonkeyPatch, reach: float
):
    monkeypatch.setattr(bundle_terms, "_NEW_REACH", reach)
    first = anew(tiny, tiny_result.first, ended)
    T = first.signs.T_world_sign.clone()
    T[0, 2, 3] += 0.25
    signs = replace(first.signs, T_world_sign=T)
    new = built(tiny, tiny_result, replace(first, signs=signs, footing=without_first(ended)))
    adjust.adjust(new)
    off = (new.values()["sign"] - ended.values()["sign"]).detach()[0, :3, 3].norm()
    of_first = ended.corners.detection[ended.corners.sign == 0].unique()
    lost = new.given_up[of_first].double().mean()
    assert (float(off) < 0.05, float(lost) < 0.2) == ((True, True) if reach > 1 else (False, False))


def test_scales_of_poses_are_not_found_anew_where_nothing_was_told_yet(
    tiny, tiny_result: MapResult, ended: Bundle
):
    again = built(tiny, tiny_result, anew(tiny, tiny_result.first, ended))
    new = built(tiny, tiny_result, replace(tiny_result.first, footing=None))
    for bundle in (again, new):
        adjust.start(bundle)
    assert torch.allclose(again.prior_scale, ended.prior_scale, rtol=0.02)
    assert (ended.prior_scale - 1).abs().max() > 0.1
    # Poses as they are given drift by nothing: that is no drift that was seen.
    assert bool((new.prior_scale[:, 1:] >= 1).all())


def test_what_was_known_of_cars_and_noise_need_not_be_found_again(
    tiny, tiny_result: MapResult, ended: Bundle
):
    first = anew(tiny, tiny_result.first, ended)
    off, steps = [], []
    for begins in (first, replace(first, footing=None)):
        bundle, taken = built(tiny, tiny_result, begins), 0
        for taken, _, _ in adjust.steps(bundle, adjust.start(bundle)):
            if taken == 0:
                away = bundle.values()["load"] - ended.values()["load"]
                off.append(float(away.detach().norm()))
        steps.append(taken)
        sign = (bundle.values()["sign"] - ended.values()["sign"]).detach()[:, :3, 3]
        assert float(sign.norm(dim=-1).max()) < 0.03
    assert off[0] < 0.3 * off[1] and steps[0] <= steps[1]


def test_stretches_that_nobody_knew_have_the_drift_beside_them(
    tiny, tiny_result: MapResult, ended: Bundle
):
    footing, nodes = footing_of(ended), ended.prior.nodes
    kept = torch.arange(len(footing.frame)) % 3 == 1
    first = anew(tiny, tiny_result.first, ended)
    some = replace(
        footing, frame=footing.frame[kept], journey=footing.journey[kept], drift=footing.drift[kept]
    )
    drift = built(tiny, tiny_result, replace(first, footing=some)).values()["drift"]
    known = torch.nonzero(kept)[:, 0]
    for row in range(len(drift)):
        own = known[nodes.journey[known] == nodes.journey[row]]
        before = own[own <= row]
        beside = before[-1] if len(before) else own[0]
        assert torch.equal(drift[row], footing.drift[beside])
    # Of a journey that had no say at all it starts as it would have without.
    other = footing.journey != 1
    none = replace(
        footing,
        frame=footing.frame[other],
        journey=footing.journey[other],
        drift=footing.drift[other],
    )
    drift = built(tiny, tiny_result, replace(first, footing=none)).values()["drift"]
    alone = built(tiny, tiny_result, replace(first, footing=None)).values()["drift"]
    mine = nodes.journey == 1
    assert torch.equal(drift[mine], alone[mine])
    assert torch.equal(drift[~mine], footing.drift[~mine])


@pytest.mark.parametrize(("before", "after"), [(STEADY, WANDERING), (WANDERING, STEADY)])
def test_biases_that_turn_out_to_wander_or_not_to_take_what_both_know(
    tiny, tiny_result: MapResult, before: PositioningNoise, after: PositioningNoise
):
    bundle = built(tiny, tiny_result, tiny_result.first, before)
    first = anew(tiny, tiny_result.first, bundle)
    footing = first.footing
    assert footing is not None
    again = built(tiny, tiny_result, first, after)
    assert again.prior_scale.shape != footing.scales["prior_scale"].shape
    assert torch.equal(again.values()["drift"][:, :6], footing.drift[:, :6])
    assert adjust.adjust(again).done


def test_a_sign_that_was_taken_for_two_is_one_in_the_end(tiny, tiny_result: MapResult):
    first = with_a_split_sign(tiny_result.first)
    found = adjusted_map(tiny, tiny_result.journey_maps, first, MapperConfig())
    assert found.first.joined == 1 and found.first.anew == 1
    here, there = (of.hd_map.signs.center_world for of in (found, tiny_result))
    assert len(here) == len(there)
    assert float(torch.cdist(there, here).amin(1).max()) < 0.05


def test_a_sign_that_is_two_after_another_beginning_is_one_without_a_third(
    tiny, tiny_result: MapResult
):
    first = replace(with_a_split_sign(tiny_result.first), anew=1)
    found = adjusted_map(tiny, tiny_result.journey_maps, first, MapperConfig())
    assert found.first.anew == 1
    signs, right = found.hd_map.signs, tiny_result.hd_map.signs
    assert len(signs) == len(right)
    assert counts_of(tiny, found, MapperConfig())[GONE] == 1
    # It has what all drives saw of it, and is as sure as the one of both that stays.
    off, same = torch.cdist(right.center_world, signs.center_world).min(1)
    assert float(off.max()) < 0.05
    assert torch.equal(signs.n_journeys[same], right.n_journeys)
    assert torch.equal(signs.n_observations[same], right.n_observations)
    of_map = len(first.signs) - 1
    assert torch.equal(found.uncertainty.center, signs.covariance[:of_map])
    assert len(found.uncertainty.corner) == of_map


def test_markers_that_were_taken_for_two_are_one_in_the_end(tiny, tiny_result: MapResult):
    split = with_split_lanes(tiny_result.first)
    within = MapperConfig().lane_join.twice_within_m
    kept = replace(MapperConfig(), duplicate_signs=DuplicateSignConfig(rounds=0))
    twice = adjusted_map(tiny, tiny_result.journey_maps, split, kept).hd_map.lanes
    found = adjusted_map(tiny, tiny_result.journey_maps, split, MapperConfig())
    # The adjustment brings them to one place, and there they are one.
    assert share_twice(twice, within) > 0.5
    assert found.first.anew == 1 and found.first.joined == 0
    lanes = found.hd_map.lanes
    assert share_twice(lanes, within) == 0 and len(lanes) == len(tiny_result.hd_map.lanes)
    # Each has what all drives saw of it, and the map of the clusters is that of before.
    assert torch.equal(lanes.n_journeys, tiny_result.hd_map.lanes.n_journeys)
    assert len(found.map_clusters.lanes) == len(twice)


def test_a_sign_that_the_adjustment_took_elsewhere_is_none(
    tiny, tiny_result: MapResult, ended: Bundle
):
    """Its head was 20 m from where the adjustment has it, as if no rays had met there."""
    first = tiny_result.first
    elsewhere = first.signs.T_world_sign.clone()
    elsewhere[0, 1, 3] += 20.0
    astray = replace(first, signs=replace(first.signs, T_world_sign=elsewhere))
    given = tiny.journeys, tiny_result.journey_maps
    config = MapperConfig()
    again, _ = made_anew(*given, astray, ended, config)
    assert again is not None and again.anew == 1 and again.joined == 1
    assert len(again.signs) == len(first.signs) - 1
    for before, after in zip(first.associations, again.associations, strict=True):
        assert torch.equal(after.sign, (before.sign - 1).clamp_min(-1))
    assert made_anew(*given, first, ended, config)[0] is None
    found = adjusted_map(tiny, tiny_result.journey_maps, again, config)
    gone = first.signs[:1].center_world
    assert float(torch.cdist(gone, found.hd_map.signs.center_world).min()) > 0.3


def test_a_sign_that_went_elsewhere_after_another_beginning_goes_without_a_third(
    tiny, tiny_result: MapResult, ended: Bundle
):
    first = tiny_result.first
    elsewhere = first.signs.T_world_sign.clone()
    elsewhere[0, 1, 3] += 20.0
    signs = replace(first.signs, T_world_sign=elsewhere)
    astray, config = replace(first, signs=signs, anew=1), MapperConfig()
    assert made_anew(tiny.journeys, tiny_result.journey_maps, astray, ended, config)[0] is None
    state = adjust.start(ended)
    found = finish_map(tiny, tiny_result.journey_maps, astray, ended, state, config)
    assert found.first.anew == 1 and counts_of(tiny, found, config)[GONE] == 1
    # The others stay as they are, as sure as they were.
    signs, right = found.hd_map.signs, tiny_result.hd_map.signs
    left = torch.arange(len(right)) != 0
    assert torch.allclose(signs.center_world, right.center_world[left], atol=1e-3)
    assert torch.equal(signs.n_observations, right.n_observations[left])
    of_map = len(first.signs) - 1
    assert torch.equal(found.uncertainty.center, signs.covariance[:of_map])
    assert len(found.uncertainty.corner) == of_map
