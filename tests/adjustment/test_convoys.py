"""Adjustments that are shared out: convoys take the steps of the whole, wherever they are and whatever ends their hosts."""

from __future__ import annotations

import gc
import os
import signal
import weakref
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment import residual_summary as summaries
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.convoys import Convoys, convoy
from crowdmap_torch.adjustment.covariance import map_uncertainty
from crowdmap_torch.adjustment.cuts import convoys
from crowdmap_torch.adjustment.residual_summary import residual_summary
from crowdmap_torch.fleet.beside import _Beside
from crowdmap_torch.fleet.choice import engine_of
from crowdmap_torch.fleet.company import Company
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.optim.solvers.journey_system import JourneyBackend
from crowdmap_torch.processes.together import ALONE
from crowdmap_torch.processes.workers import Workers

STEPS = 3


def bundle_of(street, *, convoy_m: float) -> Bundle:
    return street.bundle(config=replace(AdjustConfig(), convoy_m=convoy_m, cut_unknowns=60))


def adjusted(street, *, convoy_m: float, engine: Engine | None = None) -> dict[str, Tensor]:
    """All that an adjustment has after some steps, and covariances there."""
    bundle = bundle_of(street, convoy_m=convoy_m)
    taken = adjust.steps(bundle, adjust.start(bundle), engine=engine)
    costs = [float(state.cost) for _, (_, state, _) in zip(range(STEPS), taken, strict=False)]
    taken.close()
    found = map_uncertainty(bundle, street.signs, street.lanes, engine)
    own = {name: value for name, value in bundle.state_dict().items() if "delta" not in name}
    told = {"center": found.center, "lanes": found.lane_sigma, "bias": found.bias_covariance}
    return {**own, **told, "costs": torch.tensor(costs, dtype=torch.float64)}


@pytest.fixture(scope="module")
def shared_out(street) -> dict[str, Tensor]:
    return adjusted(street, convoy_m=50.0)


def test_convoys_come_to_where_all_drives_together_come(street, shared_out):
    whole = adjusted(street, convoy_m=0.0)
    assert len(bundle_of(street, convoy_m=50.0).convoys) > 1
    for name, value in whole.items():
        # Sums in another order: a step's matrix has a condition of up to 1e10.
        close = torch.allclose(shared_out[name].double(), value.double(), rtol=1e-5, atol=1e-8)
        assert close, name


def test_a_host_that_is_killed_changes_nothing(street, shared_out, monkeypatch):
    killed = []
    start = Workers.start

    def shot(self: Workers, key: object, call) -> None:
        start(self, key, call)
        if len(killed) < 2 and len(calls) in (20, 45):
            killed.append(self._processes[-1].pid)
            os.kill(killed[-1], signal.SIGKILL)
        calls.append(call[0])

    calls: list[str] = []
    monkeypatch.setattr(Workers, "start", shot)
    with engine_of("processes", workers=2) as engine:
        found = adjusted(street, convoy_m=50.0, engine=engine)
    assert len(killed) == 2
    assert engine.spent.again == 2
    assert all(torch.equal(found[name], value) for name, value in shared_out.items())


def test_a_host_that_is_killed_at_the_end_of_a_step_begins_where_the_step_began(
    street, shared_out, monkeypatch
):
    renew, killed = Company.renew, []

    def shot(self: Company, change) -> None:
        if not killed:
            # None of its members has come to the end yet, and the bundle is where the step began.
            (beside,) = self._hosts
            assert isinstance(beside, _Beside)
            host = beside._pool._processes[-1]
            os.kill(host.pid, signal.SIGSTOP)
            os.kill(host.pid, signal.SIGKILL)
            host.wait()
            killed.append(host.pid)
        renew(self, change)

    monkeypatch.setattr(Company, "renew", shot)
    with engine_of("processes", workers=1) as engine:
        found = adjusted(street, convoy_m=50.0, engine=engine)
    assert engine.spent.again == 1
    assert all(torch.equal(found[name], value) for name, value in shared_out.items())


def test_an_adjustment_in_convoys_goes_on_where_it_was_interrupted(street, shared_out):
    whole, other = (bundle_of(street, convoy_m=50.0) for _ in range(2))
    taken = adjust.steps(whole, adjust.start(whole))
    number, state, _ = next(taken)
    there = deepcopy(adjust.standing(whole, state, number + 1))
    taken.close()
    costs = [float(state.cost)]
    on = adjust.steps(other, adjust.go_on(other, there), first=there.steps)
    costs += [float(state.cost) for _, (_, state, _) in zip(range(STEPS - 1), on, strict=False)]
    on.close()
    assert costs == shared_out["costs"].tolist()
    assert torch.equal(other.values()["sign"], shared_out["base_sign"])


def test_parts_of_a_bundle_cost_what_the_whole_costs(street):
    bundle = bundle_of(street, convoy_m=50.0)
    state = adjust.start(bundle)
    with Convoys(bundle, state) as shared:
        after, _ = shared.step()
    assert set(after.values) == set(state.values)
    assert all(after.values[name].shape == value.shape for name, value in state.values.items())
    assert torch.equal(bundle.values()["sign"], after.values["sign"])
    parts = [convoy(bundle, None, *of).bundle(ALONE) for of in bundle.convoys]
    assert sum(len(part.corners) for part in parts) == len(bundle.corners)
    assert sum(len(part.lane_points) for part in parts) == len(bundle.lane_points)


def test_what_convoys_tell_of_residuals_is_that_of_the_whole(street):
    bundle = bundle_of(street, convoy_m=50.0)
    _, _, seen = next(taken := adjust.steps(bundle, adjust.start(bundle)))
    found = seen()
    taken.close()
    expected = residual_summary(bundle)
    assert {name for name, term in found.items() if term.rows} == {
        name for name, term in expected.items() if term.rows
    }
    for name, term in expected.items():
        assert (found[name].rows, found[name].down_weighted) == (term.rows, term.down_weighted)
        assert found[name].cost == pytest.approx(term.cost, rel=1e-9)
        shown, all_of_them = found[name].squared.sort().values, term.squared.sort().values
        assert torch.allclose(shown, all_of_them, rtol=1e-6, atol=1e-9), name


def test_a_bundle_has_its_lenses_again_when_convoys_are_gone(street):
    config = replace(AdjustConfig(), convoy_m=50.0, cut_unknowns=60)
    bundle = street.bundle(config=config, calibration=CalibrationConfig())
    taken = adjust.steps(bundle, adjust.start(bundle))
    _, _, seen = next(taken)
    expected = seen()
    taken.close()
    assert bundle.values()["optics"].abs().max() > 0
    map_uncertainty(bundle, street.signs, street.lanes)
    for name, term in residual_summary(bundle).items():
        assert term.cost == pytest.approx(expected[name].cost, rel=1e-9), name


def test_factors_go_with_their_convoys(street):
    bundle = bundle_of(street, convoy_m=50.0)
    state = adjust.start(bundle)
    gc.disable()
    try:
        with Convoys(bundle, state) as shared:
            shared.step()
            backend = shared._own.backend()
            assert isinstance(backend, JourneyBackend)
            factors = weakref.ref(backend._summed)
            del backend
            assert factors() is not None
        assert factors() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("convoy_m", [0.0, 50.0])
def test_a_bundle_goes_with_the_last_who_has_it(street, convoy_m: float):
    """What refers to itself in a circle stays until somebody looks: two adjustments would be in memory."""
    bundle = bundle_of(street, convoy_m=convoy_m)
    there = weakref.ref(bundle)
    gc.disable()
    try:
        assert all(seen() for _, _, seen in adjust.steps(bundle, adjust.start(bundle)))
        map_uncertainty(bundle, street.signs, street.lanes)
        del bundle
        assert there() is None
    finally:
        gc.enable()


def test_a_summary_shows_some_of_many_rows(street, monkeypatch):
    bundle = bundle_of(street, convoy_m=0.0)
    adjust.start(bundle)
    whole = residual_summary(bundle)["sign_reprojection"]
    monkeypatch.setattr(summaries, "_MOST_ROWS", 100)
    part = residual_summary(bundle)["sign_reprojection"]
    assert (part.cost, part.rows, part.down_weighted) == (
        *(whole.cost, len(whole.squared)),
        int((whole.weight < 0.5).sum()),
    )
    every = -(-whole.rows // 100)
    assert torch.equal(part.squared, whole.squared[::every])
    assert torch.equal(part.weight, whole.weight[::every])


def test_convoys_drive_about_as_much_each():
    journey = torch.arange(6).repeat_interleave(2)
    way = torch.tensor([0.0, 10.0]).repeat(6)
    assert convoys(journey, way, 6, 25.0) == [(0, 3), (3, 6)]
    assert convoys(journey, way, 6, 31.0) == [(0, 6)]
    assert convoys(journey, way, 6, 0.0) == [(0, 6)]
    # Where none may be parted, each is one.
    assert convoys(journey, way, 6, 1.0) == [(n, n + 1) for n in range(6)]
    # Two hosts have as many each, where three convoys would be long enough, or five.
    assert convoys(journey, way, 6, 18.0) == [(0, 3), (3, 6)]
    assert len(convoys(journey, way, 6, 12.0)) == 4
