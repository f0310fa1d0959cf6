"""Mistakes are made where they can be."""

from __future__ import annotations

from dataclasses import replace

from crowdmap_torch.soak.spoiled import MISTAKES
from crowdmap_torch.tables import Dataset

OF_LENSES = {"undistorted", "no-lens", "coefficients"}


def with_lens(dataset: Dataset, model: str, distortion: list[float]) -> Dataset:
    journeys = []
    for journey in dataset.journeys:
        camera = journey.rig.camera
        other = replace(camera, model=model, distortion=camera.K.new_tensor(distortion))
        journeys.append(replace(journey, rig=replace(journey.rig, camera=other)))
    return replace(dataset, journeys=tuple(journeys))


def test_a_lens_is_mistaken_only_where_there_is_one(tiny: Dataset) -> None:
    def impossible(dataset: Dataset) -> set[str]:
        return {name for name, mistake in MISTAKES.items() if not mistake.can_be_made(dataset)}

    assert impossible(with_lens(tiny, "brown_conrady", [-0.1, 0.02, 0.0, 0.0])) == set()
    assert impossible(with_lens(tiny, "brown_conrady", [])) == OF_LENSES
    assert impossible(with_lens(tiny, "brown_conrady", [0.0] * 4)) == OF_LENSES
    fisheye = with_lens(tiny, "kannala_brandt", [0.01, 0.002, 0.0, 0.0])
    assert impossible(fisheye) == {"no-lens", "coefficients"}
