from __future__ import annotations

import pytest
import torch

from crowdmap_torch.road.vanishing_point import LaneRays, VanishingConfig, fit_vanishing

F64 = torch.float64
HEIGHT = 1.5
FOCAL = 1000.0


def markers(
    offsets: tuple[float, ...],
    *,
    alpha: float = 0.0,
    heading: float = 0.0,
    bend: float = 0.0,
    climb: float = 0.0,
    twist: float = 0.0,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    frames: int = 1,
    generator: torch.Generator | None = None,
) -> LaneRays:
    """The image of markers side by side on a road that bends, climbs (1/m each) and twists."""
    Z = torch.linspace(5, 30, 15, dtype=F64).expand(frames, len(offsets), 15)
    X = torch.tensor(offsets, dtype=F64)[None, :, None] + heading * Z + bend * Z**2 / 2
    above = climb * Z**2 / 2 + twist * Z * X
    # beta x + y + alpha = (h - above) / Z
    x, y = X / Z, (HEIGHT - above) / Z - alpha
    if noise_px:
        x = x + noise_px / FOCAL * torch.randn(x.shape, dtype=F64, generator=generator)
        y = y + noise_px / FOCAL * torch.randn(x.shape, dtype=F64, generator=generator)
    if outliers:
        wrong = torch.rand(x.shape, dtype=F64, generator=generator) < outliers
        x = x + torch.where(wrong, 0.03, 0.0)
    detection = torch.arange(frames * len(offsets)).repeat_interleave(15)
    frame = torch.arange(frames).repeat_interleave(len(offsets))
    return LaneRays(detection, frame, frames, x.flatten(), y.flatten())


def fit(rays: LaneRays, **config):
    start = torch.zeros(rays.frames, dtype=F64)
    return fit_vanishing(rays, start, HEIGHT, 1 / FOCAL, VanishingConfig(**config))


@pytest.mark.parametrize("alpha", [-0.02, 0.0, 0.026])
@pytest.mark.parametrize("bend", [0.0, 0.005])
def test_pitch_of_exact_markers(alpha: float, bend: float) -> None:
    found = fit(markers((-5.2, -1.7, 1.8), alpha=alpha, heading=0.05, bend=bend))
    assert abs(found.alpha.item() - alpha) < 1e-5
    assert abs(found.bend.item() - bend) < 1e-4
    offsets = torch.tensor([-5.2, -1.7, 1.8], dtype=F64) / HEIGHT
    torch.testing.assert_close(found.offset, offsets, atol=1e-3, rtol=0)


def test_two_markers_are_enough_and_one_is_not() -> None:
    two, one = fit(markers((-1.7, 1.8), alpha=0.02)), fit(markers((1.8,), alpha=0.02))
    assert abs(two.alpha.item() - 0.02) < 1e-5 and two.variance.sqrt() < 2e-3
    assert one.variance.sqrt() > 0.05


def test_variance_and_outliers(generator: torch.Generator) -> None:
    clean = fit(
        markers((-1.7, 1.8, 5.3), noise_px=1.0, frames=400, generator=generator), bend_sigma=0.0
    )
    scatter = clean.alpha.square().mean().sqrt()
    assert 0.7 < scatter / clean.variance.mean().sqrt() < 1.3
    spoilt = fit(
        markers((-1.7, 1.8, 5.3), noise_px=1.0, outliers=0.1, frames=400, generator=generator),
        bend_sigma=0.0,
    )
    assert spoilt.alpha.abs().median() < 1.3 * clean.alpha.abs().median()


@pytest.mark.parametrize("shape", ["climb", "twist"])
def test_response_to_a_road_that_is_no_plane(shape: str) -> None:
    amount = 1e-5
    offsets = (-5.2, -1.7, 1.8)
    curved = {
        "climb": lambda: markers(offsets, climb=amount),
        "twist": lambda: markers(offsets, twist=amount),
    }
    flat, bent = fit(markers(offsets)), fit(curved[shape]())
    response = {"climb": flat.by_curvature, "twist": flat.by_twist}[shape].item()
    change = (bent.alpha - flat.alpha).item()
    assert change == pytest.approx(response * amount, rel=0.02)


def test_frames_without_markers_are_left_unknown() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    found = fit(LaneRays(none, none, 3, torch.zeros(0, dtype=F64), torch.zeros(0, dtype=F64)))
    assert bool((found.alpha == 0).all() and (found.variance.sqrt() > 0.05).all())
