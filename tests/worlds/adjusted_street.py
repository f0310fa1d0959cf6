"""A simulated street whose associations are the true ones, and its bundle after the adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from worlds.drives import signs_by_detection

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Association, Dataset, Journey, Lanes, RoadEstimate, Signs

START_SIGMA_M = 0.1
"""What the cluster heads are off by at the start, along each axis."""


@dataclass(frozen=True)
class Street:
    """All that a bundle is built from."""

    journeys: tuple[Journey, ...]
    roads: tuple[RoadEstimate, ...]
    signs: Signs
    lanes: Lanes
    associations: tuple[Association, ...]
    drifts: tuple[Tensor, ...]

    def bundle(
        self,
        *,
        left_out: tuple[int, ...] = (),
        config: AdjustConfig | None = None,
        positioning: PositioningNoise | None = None,
        calibration: CalibrationConfig | None = None,
    ) -> Bundle:
        return adjust.build(
            self.journeys,
            self.roads,
            self.signs,
            self.lanes,
            self.associations,
            self.drifts,
            positioning or PositioningNoise(),
            config or AdjustConfig(),
            trusted=[
                torch.full_like(journey.t_ns, number not in left_out, dtype=torch.bool)
                for number, journey in enumerate(self.journeys)
            ],
            calibration=calibration,
        )


def true_association(truth: JourneyTruth, signs: Signs, row_of_sign: Tensor) -> Association:
    """What each detection truly shows, and which of its corners is the sign's first."""
    journey = truth.journey
    true = signs_by_detection(truth)
    row = torch.where(true >= 0, row_of_sign[true], -1)
    row = torch.where(row_of_shape(signs, row) == journey.signs.shape, row, -1)
    seen = torch.nonzero(row >= 0)[:, 0]
    of = signs[row[seen]]
    T = truth.T_world_camera[journey.signs.frame[seen]]
    px, _ = camera.project(
        journey.rig.camera, se3.transform(se3.inverse(T)[:, None], of.corners_world)
    )
    shift = torch.zeros_like(row)
    shift[seen], _ = polygon.best_shift(
        px, journey.signs.corners_px[seen], polygon.corner_count(of.shape)
    )
    return Association(row, shift, torch.full_like(journey.lanes.row, -1))


def row_of_shape(signs: Signs, row: Tensor) -> Tensor:
    return torch.where(row >= 0, signs.shape[row.clamp_min(0)], -1)


def street_of(dataset: Dataset, folder: Path, truth: Truth, result: MapResult) -> Street:
    """The street of a dataset that was simulated: its signs near their true places, all that was mapped of the rest."""
    survey = read_map(folder / "survey").signs
    shown = torch.cat([signs_by_detection(t) for t in truth.journeys])
    often = torch.bincount(shown[shown >= 0], minlength=len(survey)) >= 20
    true_signs = survey[often]
    row_of_sign = torch.where(often, often.cumsum(0) - 1, -1)
    noise = torch.randn(
        len(true_signs), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    T = true_signs.T_world_sign.clone()
    T[:, :3, 3] += START_SIGMA_M * noise
    return Street(
        journeys=dataset.journeys,
        roads=tuple(m.road for m in result.journey_maps),
        signs=replace(true_signs, T_world_sign=T),
        lanes=result.first.lanes,
        associations=tuple(true_association(t, true_signs, row_of_sign) for t in truth.journeys),
        drifts=tuple(torch.zeros(j.frame_count, 6, dtype=torch.float64) for j in dataset.journeys),
    )


@dataclass(frozen=True)
class Adjusted:
    """A bundle after its adjustment, and what was seen on the way."""

    bundle: Bundle
    reason: str
    scales: Tensor
    costs: list[float]


def adjusted_of(street: Street) -> Adjusted:
    """The street's bundle, adjusted step by step."""
    bundle = street.bundle()
    state = begun = adjust.start(bundle)
    scales, costs = [bundle.scale.clone()], [float(state.cost)]
    for _, state, _ in adjust.steps(bundle, begun):
        scales.append(bundle.scale.clone())
        costs.append(float(state.cost))
    return Adjusted(bundle, state.reasons[0], torch.stack(scales), costs)
