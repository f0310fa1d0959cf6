"""Where an adjustment stands between two steps: what is kept of it, and going on from there."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from worlds.adjusted_street import Adjusted, Street

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.io.stages import read_stage, write_stage
from crowdmap_torch.io.trees import digest
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.solvers import assembly


def test_increments_are_zero_at_rest(street: Street, adjusted: Adjusted):
    for bundle in (street.bundle(), adjusted.bundle):
        assert {name for name, _ in bundle.named_parameters()} == {
            f"delta_{name}" for name in bundle.names
        }
        for name, value in bundle.values().items():
            assert not getattr(bundle, f"delta_{name}").any()
            assert torch.allclose(value, getattr(bundle, f"base_{name}"), atol=1e-12)


def test_a_bundle_goes_on_from_its_state_dict(street: Street, adjusted: Adjusted, tmp_path: Path):
    torch.save(adjusted.bundle.state_dict(), tmp_path / "bundle.pt")
    other = street.bundle()
    other.load_state_dict(torch.load(tmp_path / "bundle.pt", weights_only=True))
    for name, value in other.values().items():
        assert torch.equal(value, adjusted.bundle.values()[name])
    same = deepcopy(adjusted.bundle)
    assert digest(other.state_dict()) == digest(same.state_dict())
    assert float(adjust.start(other).cost) == float(adjust.start(same).cost)


def reject_steps(monkeypatch: pytest.MonkeyPatch, numbers: tuple[int, ...]) -> None:
    """Makes these steps end where everything costs more."""
    step, costs, is_bad = lm.step, assembly.term_costs, [False]

    def taken(problem, state, *arguments, **options):
        is_bad[0] = state.iterations in numbers
        return step(problem, state, *arguments, **options)

    def dearer(*arguments):
        return {k: cost + 1e9 * is_bad[0] for k, cost in costs(*arguments).items()}

    monkeypatch.setattr(lm, "step", taken)
    monkeypatch.setattr(assembly, "term_costs", dearer)


@pytest.mark.parametrize(
    ("cut_unknowns", "most", "rejected"),
    [(0, 30, ()), (40, 3, ()), (0, 6, (2, 3))],
    ids=["whole drives", "drives that are cut", "with rejected steps"],
)
def test_an_adjustment_cut_at_any_step_goes_on_to_the_same_bits(
    street: Street,
    cut_unknowns: int,
    most: int,
    rejected: tuple[int, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    reject_steps(monkeypatch, rejected)
    config = AdjustConfig(cut_unknowns=cut_unknowns, frame_spacing_m=6.0)
    config = replace(config, lm=replace(config.lm, max_iterations=most))
    whole, kept = street.bundle(config=config), tmp_path / "step.pt"
    state = begun = adjust.start(whole)
    write_stage(kept, adjust.standing(whole, begun, 0), key="")
    number = -1
    for number, state, _ in adjust.steps(whole, begun):
        # Each step is taken once more by a bundle that knows of the one before only what was kept.
        other = street.bundle(config=config)
        before = read_stage(kept, adjust.Standing, key="")
        again = adjust.go_on(other, before)
        first, again, _ = next(adjust.steps(other, again, first=before.steps))
        assert first == number and bool(again.accepted) == (number not in rejected)
        here, there = (
            adjust.standing(*one, number + 1) for one in ((whole, state), (other, again))
        )
        write_stage(kept, here, key="")
        # A step that is rejected keeps the normal equations; a bundle that goes on makes them anew.
        there = replace(there, state=replace(there.state, linearizations=here.state.linearizations))
        assert digest(there) == digest(here)
    assert number + 1 == most if most < 30 else state.done
    # Nor is there a step after the last one.
    other = street.bundle(config=config)
    again = adjust.go_on(other, read_stage(kept, adjust.Standing, key=""))
    assert [*adjust.steps(other, again, first=number + 1)] == []
    assert digest(other.state_dict()) == digest(whole.state_dict())


def test_a_bundle_does_not_go_on_from_where_another_one_stood(street: Street, adjusted: Adjusted):
    there = adjust.standing(adjusted.bundle, adjust.start(deepcopy(adjusted.bundle)), 3)
    fewer = replace(
        street,
        signs=street.signs[torch.arange(len(street.signs) - 1)],
        associations=tuple(
            replace(a, sign=torch.where(a.sign < len(street.signs) - 1, a.sign, -1))
            for a in street.associations
        ),
    )
    with pytest.raises(ValueError, match=r"is torch.* expected torch.*, as the bundle has it"):
        adjust.go_on(fewer.bundle(), there)
    with pytest.raises(ValueError, match=r"'scale' is missing; expected torch\.float64"):
        others = {k: v for k, v in there.bundle.items() if k != "scale"}
        adjust.go_on(street.bundle(), replace(there, bundle=others))
