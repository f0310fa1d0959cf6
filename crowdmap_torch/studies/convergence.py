"""Whether the start and gross outliers decide: the adjustment from a metre off, and with detections far from their signs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.documents import plain
from crowdmap_torch.mapper import FirstMap, build_bundle, first_map
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import number, results
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task
from crowdmap_torch.tables import Journey

OUTLIERS = 0.03
"""Share of detections that are made outliers."""
OUTLIER_PX = (10.0, 40.0)
"""How far off they are, in any direction."""
_MOVES = (
    ("outliers: mean [mm]", "outliers.mean"),
    ("95 % [mm]", "outliers.p95"),
    ("max [mm]", "outliers.max"),
    ("left out: mean [mm]", "left_out.mean"),
    ("max [mm]", "left_out.max"),
    ("outliers against left out: mean [mm]", "between.mean"),
    ("max [mm]", "between.max"),
    ("a metre off: mean [mm]", "far.mean"),
    ("max [mm]", "far.max"),
    ("its poses: mean [mm]", "far_pose_m"),
)
"""Columns of the table, and where their numbers [m] are."""
_DRAWN = {"outliers": "outliers.mean", "left out": "left_out.mean", "a metre off": "far.mean"}


@dataclass(frozen=True)
class MeasureConvergence(Task):
    """How far the adjusted signs move with outliers, without those detections, and from a start a metre off."""

    simulation: SimulationConfig
    count: int

    @property
    def key(self) -> str:
        """Of the map that the others are compared with."""
        return f"{self._map.key}-convergence"

    @property
    def cost_s(self) -> float:
        """Of four adjustments."""
        return 4 * self._map.cost_s

    @property
    def _map(self) -> MeasureMap:
        return MeasureMap(self.simulation, self.count)

    def needs(self) -> Sequence[Task]:
        """The single journeys."""
        return self._map.needs()

    def run(self, folder: StudyFolder) -> None:
        """Adjusts the same map four times."""
        drives, maps = self._map.load(folder)
        config, journeys = MapperConfig(), drives.dataset.journeys
        begun = time.process_time()
        first = first_map(journeys, maps, config)
        generator = torch.Generator().manual_seed(self.simulation.seed)
        far = a_metre_off(first, generator)
        bundles = [build_bundle(journeys, maps, start, config) for start in (first, far)]
        for rows in outliers(bundles[0].corners, generator):
            bundles.append(build_bundle(journeys, maps, first, config))
            bundles[-1].see(rows)
        clean, from_far, with_outliers, without = (
            _adjusted(bundle, first, journeys) for bundle in bundles
        )
        mask = first.signs.corner_mask
        measured: dict[str, Any] = {
            "signs": len(first.signs),
            "outliers": _moved(clean.corners, with_outliers.corners, mask),
            "left_out": _moved(clean.corners, without.corners, mask),
            "between": _moved(without.corners, with_outliers.corners, mask),
            "far": _moved(clean.corners, from_far.corners, mask),
            "far_pose_m": float((from_far.position - clean.position).norm(dim=1).mean()),
            "finite": from_far.is_finite and with_outliers.is_finite,
            "seconds": {"adjusted": time.process_time() - begun},
        }
        folder.write_result(self.key, plain(measured))


def outliers(
    corners: CornerObservations, generator: torch.Generator
) -> tuple[CornerObservations, CornerObservations]:
    """The rows with some detections moved in the image as a whole, and the rows without those detections."""
    _, detection = torch.unique(corners.detection // 2, return_inverse=True)
    count = int(detection.max()) + 1 if len(detection) else 0
    chance, turn, way = torch.rand(3, count, generator=generator, dtype=torch.float64).to(
        corners.matrix
    )
    is_far, angle = chance < OUTLIERS, 2 * torch.pi * turn
    low, high = OUTLIER_PX
    length = torch.where(is_far, low + (high - low) * way, 0.0)
    push = length[:, None] * torch.stack((angle.cos(), angle.sin()), dim=1)
    matrix = corners.matrix.clone()
    # The pixel is what the first two rows take off, in units of the depth, which is the third.
    matrix[:, :2] -= push[detection][..., None] * corners.matrix[:, 2:]
    px = corners.px + push[detection]
    return replace(corners, px=px, matrix=matrix), corners[~is_far[detection]]


def a_metre_off(first: FirstMap, generator: torch.Generator) -> FirstMap:
    """The start with every sign a metre off in a direction of its own, and every journey's positions too."""

    def metre(count: int) -> Float[Tensor, "n 3"]:
        way = torch.randn(count, 3, generator=generator, dtype=torch.float64)
        return torch.nn.functional.normalize(way, dim=-1).to(first.signs.T_world_sign)

    T = first.signs.T_world_sign.clone()
    T[:, :3, 3] += metre(len(T))
    biases = metre(len(first.drifts))
    drifts = tuple(
        drift + torch.cat((bias, torch.zeros_like(bias)))
        for drift, bias in zip(first.drifts, biases, strict=True)
    )
    return replace(first, signs=replace(first.signs, T_world_sign=T), drifts=drifts)


@dataclass(frozen=True)
class _Adjusted:
    corners: Float[Tensor, "n 8 3"]
    position: Float[Tensor, "p 3"]
    is_finite: bool


@torch.no_grad()
def _adjusted(bundle: Bundle, first: FirstMap, journeys: Sequence[Journey]) -> _Adjusted:
    adjust.adjust(bundle)
    signs, _ = adjust.read_map(bundle, first.signs, first.lanes)
    values = bundle.values()
    is_finite = all(bool(value.isfinite().all()) for value in values.values())
    position = torch.cat(adjust.read_poses(bundle, journeys))[:, :3, 3]
    return _Adjusted(signs.corners_world, position, is_finite)


def _moved(before: Tensor, after: Tensor, mask: Tensor) -> dict[str, float]:
    away = (after - before).norm(dim=-1)[mask]
    return {"mean": float(away.mean()), "p95": float(away.quantile(0.95)), "max": float(away.max())}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """One data set for each seed."""
    for task in _measured(settings.scale):
        yield task.simulation.seed + 1, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """What moved by how much, seed by seed."""
    rows, bars, finite = [], {}, True
    for task in _measured(settings.scale):
        for found in results((task,), folder):
            finite = finite and bool(found["finite"])
            moved = {path: 1000 * number(found, path) for _, path in _MOVES}
            rows.append((task.simulation.seed, *moved.values()))
            bars[f"seed {task.simulation.seed}"] = {
                name: (moved[path], 0.0) for name, path in _DRAWN.items()
            }
    columns = ("seed", *(title for title, _ in _MOVES))
    scale = settings.scale
    low, high = OUTLIER_PX
    return Chapter(
        text=(
            f"{scale.journeys} journeys. How far the corners of the adjusted signs move when {100 * OUTLIERS:.0f} % more "
            f"of the detections are {low:.0f} to {high:.0f} pixels off; when the same detections are not there at all, "
            "which is what an estimator that knows them would make of it; and when every sign and every journey starts a "
            f"metre off. Every unknown stayed finite: {'yes' if finite else 'NO'}.",
        ),
        tables=(Table("convergence", columns, tuple(rows)),),
        plots={"convergence": plot_bars(bars, x="mean move of the corners [mm]")},
    )


def _measured(scale: Scale) -> list[MeasureConvergence]:
    return [
        MeasureConvergence(scale.drives(seed), scale.journeys) for seed in range(scale.short_seeds)
    ]


STUDY = Study("convergence", "Do the start and outliers decide?", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
