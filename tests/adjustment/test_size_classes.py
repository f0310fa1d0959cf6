"""Sizes that signs are made in, and the settings that tell of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.adjusted_street import Adjusted, Street

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.config import AdjustConfig


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
