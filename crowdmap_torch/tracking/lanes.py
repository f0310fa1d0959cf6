"""IV-A, lanes: lane marker detections of successive frames linked into tracklets, causally, by optimal assignment."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import gated_matching, matching_of_near
from crowdmap_torch.tables import Journey, LaneDetections, LanePoints, Rig, Tracklets
from crowdmap_torch.tracking.causal import (
    ActiveTracklets,
    CausalAssociator,
    CostLookup,
    costs_on_demand,
    rows_of_frames,
    window_costs,
)
from crowdmap_torch.tracking.lane_features import (
    GroundLines,
    LaneAssociationConfig,
    LaneFeatures,
    lane_features,
    lane_pair_costs,
)


class LaneAssociator(CausalAssociator[ActiveTracklets, LaneFeatures]):
    """Links the lane detections of one frame after another into tracklets (IV-A); never looks ahead."""

    def __init__(self, config: LaneAssociationConfig) -> None:
        none = np.zeros(0, dtype=np.int64)
        super().__init__(ActiveTracklets(none, none))
        self.config = config

    def advance(
        self, frame: Int[np.ndarray, " d"], rows: Int[np.ndarray, " m"], pair_costs: CostLookup
    ) -> Int[np.ndarray, " m"]:
        """Tracklet of each of the detections `rows`, which are those of one frame.

        `frame` is that of every detection that costs are asked of, last measurements included.
        """
        if not len(rows):
            return rows
        silent_for = frame[rows[0]] - frame[self.active.last]
        old = self.active[silent_for <= self.config.window]
        cost = pair_costs(old.last[:, None], rows[None])
        if self.config.method == "paper2017":
            row, column = matching_of_near(cost, self.config.paper.max_cost_px2)
        else:
            row, column = gated_matching(cost, self.config.unmatched_cost)
        label = self._labels(old, row, column, len(rows))
        self.active = old.without(row).followed_by(ActiveTracklets(label, rows))
        return label

    @torch.no_grad()
    def step(
        self,
        frame: int,
        T_world_camera: Float[Tensor, "4 4"],
        detections: LaneDetections,
        points: LanePoints,
        rig: Rig,
    ) -> Int[Tensor, " m"]:
        """Tracklet of each of one frame's detections; frame indices must increase.

        `points.detection` counts from the frame's first detection. Only last measurements of active tracklets are kept.
        """
        detections = replace(detections, frame=torch.full_like(detections.frame, frame))
        pose = T_world_camera.expand(len(detections), 4, 4)
        new = lane_features(detections, points, rig, pose, self.config)
        features, rows = self._behind_recent(new)
        costs = costs_on_demand(features, partial(lane_pair_costs, config=self.config))
        label = self.advance(features.frame.numpy(), rows, costs)
        self._keep_last(features)
        return torch.from_numpy(label).to(detections.frame.device)


@torch.no_grad()
def associate_lanes(journey: Journey, config: LaneAssociationConfig) -> Tracklets:
    """Tracklets of a journey's lane detections, exactly those that one frame after another gives (IV-A)."""
    detections = journey.lanes
    pose = journey.T_world_camera[detections.frame]
    features = lane_features(detections, journey.lane_points, journey.rig, pose, config)
    order = torch.argsort(detections.frame, stable=True)
    features = features[order]
    if config.method == "paper2017":
        pair_costs = partial(lane_pair_costs, config=config)
        costs = window_costs(features, pair_costs, window=config.window, chunk=config.chunk_pairs)
    else:
        costs = partial(GroundLines.of(features, config).costs, config=config)
    associator = LaneAssociator(config)
    frame = features.frame.cpu().numpy()
    label = np.full(len(order), -1)
    for rows in rows_of_frames(frame):
        label[rows] = associator.advance(frame, rows, costs)
    back = torch.argsort(order)
    return Tracklets(torch.from_numpy(label).to(order.device)[back], associator.count)
