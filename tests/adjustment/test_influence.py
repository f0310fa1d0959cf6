"""What a map would be without one of its drives, foretold by the sum of the others' systems."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.convoys import Convoys
from crowdmap_torch.adjustment.covariance import map_uncertainty
from crowdmap_torch.adjustment.influence import influence
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.optim.solvers.journey_system import MapSystem
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky


def systems(bundle: Bundle, drives: list[int]) -> MapSystem:
    with Convoys(bundle, None, parts=[(n, n + 1) for n in drives]) as convoys:
        return convoys.systems()


def step(whole: MapSystem, *without: int) -> dict[str, Tensor]:
    found = whole.step(without=without)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def every(street) -> list[int]:
    return list(range(len(street.journeys)))


@pytest.fixture(scope="module")
def bundle(adjusted) -> Bundle:
    return deepcopy(adjusted.bundle)


@pytest.fixture(scope="module")
def whole(bundle, every) -> MapSystem:
    return systems(bundle, every)


def centers(street, *, without: int) -> Tensor:
    """Where signs are once all drives but one were adjusted."""
    bundle = street.bundle(left_out=(without,))
    for _ in adjust.steps(bundle, adjust.start(bundle)):
        pass
    return bundle.values()["sign"][:, :3, 3]


def test_systems_add_up_to_the_map(bundle, whole):
    problem = bundle.problem()
    equations = bundle.backend().assemble(problem, bundle.values())
    cost = torch.stack([one.cost for one in whole.systems]).sum()
    torch.testing.assert_close(cost, equations.cost[0], rtol=1e-9, atol=0)
    undamped = equations.solve(torch.zeros(1, dtype=torch.float64)).delta
    for name in ("sign", "lane"):
        torch.testing.assert_close(step(whole)[name], undamped[name], rtol=1e-3, atol=1e-6)


def test_every_drive_says_something_of_what_it_saw_alone(bundle, whole, every):
    for drive in every:
        seen = bundle.corners.sign[bundle.corners.journey == drive].unique()
        assert torch.equal(whole.of_drives[drive].block["sign"], seen)


def test_what_is_left_out_is_as_if_it_had_never_been(bundle, whole, every):
    others = systems(bundle, [n for n in every if n != 1])
    for name, of in step(others).items():
        assert torch.equal(of, step(whole, 1)[name])


def test_what_a_map_would_be_without_a_drive_is_foretold(street, bundle, whole, every):
    here, at_rest = bundle.values()["sign"][:, :3, 3], step(whole)["sign"]
    for drive in every:
        foretold = (step(whole, drive)["sign"] - at_rest)[:, :3]
        seen_by = torch.stack(
            [
                torch.isin(torch.arange(len(here)), one.block["sign"])
                for n, one in enumerate(whole.of_drives)
                if n != drive
            ]
        )
        left = seen_by.sum(0) > 1
        moved = (centers(street, without=drive) - here)[left]
        missed = (foretold[left] - moved).norm(dim=1).square().mean().sqrt()
        assert missed < 0.35 * moved.norm(dim=1).square().mean().sqrt()


def test_figures_are_those_of_the_moves(bundle, whole, street, every):
    covariance = map_uncertainty(bundle, street.signs, street.lanes).center
    found = influence(bundle, covariance)
    seen = [one.block["sign"] for one in whole.of_drives]
    number = torch.bincount(torch.cat(seen), minlength=len(covariance))
    for drive in every:
        own = whole.of_drives[drive].block["sign"]
        shared = own[number[own] > 1]
        assert int(found.alone[drive]) == len(own) - len(shared)
        move = (step(whole, drive)["sign"] - step(whole)["sign"])[shared, :3]
        assert float(found.farthest_m[drive]) == pytest.approx(float(move.norm(dim=1).max()))
        assert int(found.farthest_sign[drive]) == int(shared[move.norm(dim=1).argmax()])
        cost = torch.einsum("ni,nij,nj->n", move, covariance[shared].inverse(), move) / 3
        assert float(found.in_sigmas[drive]) == pytest.approx(float(cost.mean().sqrt()))
        move = (step(whole, drive)["lane"] - step(whole)["lane"]).double()
        across = torch.einsum("ck,ck->c", move, bundle.lane_axes[..., 1])
        others = [one.block["lane"] for n, one in enumerate(whole.of_drives) if n != drive]
        seen = whole.of_drives[drive].block["lane"]
        both = across[seen[torch.isin(seen, torch.cat(others))]]
        assert float(found.across_m[drive]) == pytest.approx(float(both.square().mean().sqrt()))


def test_of_signs_that_went_into_others_the_farthest_is_the_one_that_stays(street, bundle, every):
    known = map_uncertainty(bundle, street.signs, street.lanes)
    known = replace(known, influence=influence(bundle, known.center))
    last = len(known.center) - 1
    into = torch.arange(last + 1)
    into[[0, last, 2]] = torch.tensor([1, 1, -1])
    assert known.influence is not None
    far = known.influence.farthest_sign.clone()
    far[:] = torch.tensor([0, last, -1])
    known = replace(known, influence=replace(known.influence, farthest_sign=far))
    left = known.of_signs(into)
    assert torch.equal(left.center, known.center[[1, *range(3, last)]])
    assert torch.equal(left.corner, known.corner[[1, *range(3, last)]])
    assert left.influence is not None
    assert left.influence.farthest_sign.tolist() == [0, 0, -1]
    far[:] = torch.tensor([2, 3, 1])
    assert known.influence is not None
    left = replace(known, influence=replace(known.influence, farthest_sign=far)).of_signs(into)
    assert left.influence is not None
    assert left.influence.farthest_sign.tolist() == [-1, 1, 0]


def test_who_has_no_say_has_no_influence(street, every):
    bundle = street.bundle(left_out=(0,))
    found = influence(bundle, torch.eye(3).double().expand(len(street.signs), 3, 3))
    assert torch.isnan(found.in_sigmas).tolist() == [n == 0 for n in every]
    assert int(found.farthest_sign[0]) == -1 and int(found.alone[0]) == 0


def test_a_map_that_cannot_be_solved_without_a_drive_has_no_figures(street, bundle, monkeypatch):
    covariance = torch.eye(3).double().expand(len(street.signs), 3, 3)
    monkeypatch.setattr(TiledCholesky, "of", lambda matrix: None)
    found = influence(bundle, covariance)
    assert found.in_sigmas.isnan().all() and found.across_m.isnan().all()


def test_hosts_tell_the_same(street, bundle):
    covariance = torch.eye(3).double().expand(len(street.signs), 3, 3)
    here = influence(bundle, covariance)
    with engine_of("processes", workers=2) as engine:
        there = influence(bundle, covariance, engine)
    assert torch.equal(here.in_sigmas, there.in_sigmas)
    assert torch.equal(here.across_m, there.across_m)
