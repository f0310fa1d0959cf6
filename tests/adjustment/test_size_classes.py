"""Sizes that signs are made in, and the settings that tell of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.adjusted_street import Adjusted, Street

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig, columns
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.landmark_terms import about_usual_size
from crowdmap_torch.residuals.sign_prior import SignHabit, habit_term


@pytest.fixture(scope="module")
def classes(street: Street) -> tuple[tuple[float, float], ...]:
    """The sizes that the signs of the street truly have: its signs start with them."""
    return tuple((width, height) for width, height in street.signs.size.tolist())


def size_error(bundle: Bundle, street: Street) -> Tensor:
    return (bundle.values()["size"] / street.signs.size).log().abs()


def test_size_classes_give_signs_their_sizes(street: Street, adjusted: Adjusted, classes):
    bundle = street.bundle(config=AdjustConfig(size_classes_m=classes))
    adjust.adjust(bundle)
    free = size_error(adjusted.bundle, street).mean()
    assert size_error(bundle, street).mean() < 0.5 * free


def test_signs_of_no_class_keep_their_sizes(street: Street, adjusted: Adjusted, classes):
    far = tuple((3 * width, 3 * height) for width, height in classes)
    bundle = street.bundle(config=AdjustConfig(size_classes_m=far))
    adjust.adjust(bundle)
    found, expected = bundle.values()["size"], adjusted.bundle.values()["size"]
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


def test_many_signs_tell_what_size_is_usual_and_one_hardly():
    size = 1.5 * torch.linspace(-0.5, 0.5, 2001).double().exp()[:, None] * torch.ones(1, 2).double()

    def usual(some: Tensor) -> Tensor:
        own = torch.arange(len(some))
        term = habit_term(torch.zeros(len(own), 3).double(), own, SignHabit())
        return about_usual_size(term, some, SignHabit()).constants[1]

    assert torch.allclose(usual(size), torch.tensor(1.5).double(), rtol=5e-3)
    assert 0.76 < float(usual(size[1000:1001])[0, 0]) < 1.1
    # Signs that nobody sees tell nothing.
    term = habit_term(torch.zeros(3, 3).double(), own := torch.arange(3), SignHabit())
    more = torch.cat((size[own], 100 * size[own]))
    seen, alone = (about_usual_size(term, of, SignHabit()) for of in (more, size[own]))
    assert torch.equal(seen.constants[1], alone.constants[1])


def test_signs_of_an_unusual_size_do_not_scale_the_map(street: Street):
    """Whether a detector draws all outlines too large no image tells from large signs: usual sizes must not either."""
    habit = SignHabit(typical_size_m=3.0, log_size=0.2)
    bundle = street.bundle(config=AdjustConfig(habit=habit), calibration=CalibrationConfig())
    adjust.adjust(bundle)
    box = columns("optics", CalibrationConfig())["box"]
    assert float(bundle.values()["optics"][:, box].detach().abs().max()) < 0.5
    assert float(size_error(bundle, street).detach().mean()) < 0.02


@pytest.mark.parametrize(
    "options",
    [
        {"size_classes_m": ((0.6, 0.0),)},
        {"size_class_sigma": 0.0},
        {"innovation_chance": 1.0},
        {"innovation_chance": -1e-3},
    ],
    ids=str,
)
def test_settings_that_cannot_be_are_refused(options):
    with pytest.raises(ValueError, match=rf"{next(iter(options))}.*expected"):
        AdjustConfig(**options)
