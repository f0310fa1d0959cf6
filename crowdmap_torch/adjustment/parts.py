"""What a bundle is made of: where its unknowns start, what is seen of them, and what is known before."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.adjustment.calibration import Fleet
from crowdmap_torch.adjustment.course import Course
from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.noise.pose_prior import PosePrior
from crowdmap_torch.optim.problem import (
    CostTerm,
    Variable,
    euclidean,
    positive,
    pull_euclidean,
    pull_positive,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.processes.together import Together

VARIABLES = {
    "pose": Variable(6, se3.retract, pull=se3.pull),
    "drift": Variable(6, euclidean, pull=pull_euclidean),
    "cut": Variable(6, euclidean, pull=pull_euclidean),
    "bias": Variable(6, euclidean, pull=pull_euclidean),
    "stance": Variable(2, euclidean, pull=pull_euclidean),
    "sign": Variable(6, se3.retract, pull=se3.pull),
    "size": Variable(2, positive, pull=pull_positive),
    "lane": Variable(3, euclidean, pull=pull_euclidean),
}
"""The unknowns: camera poses, their slow errors, at stretches of road and where long drives are cut, and each journey's
constant one; how its camera stands in the car; signs, their sides, lanes' coefficients."""


@dataclass(frozen=True)
class Unknowns:
    """Where the unknowns start, and what they are of."""

    values: dict[str, Tensor]
    """By name of the bundle's variables."""
    frame: Int[Tensor, " p"]
    """Frame of each pose, counted over all journeys."""
    lane_count: Int[Tensor, " n"]
    """Coefficients of each lane."""


@dataclass(frozen=True)
class Observations:
    """What images say of them."""

    corners: CornerObservations
    lane_points: LanePointObservations
    matches: LaneMatches
    """Where each lane point starts."""
    lenses: tuple[Camera, ...]
    """The cameras that they were seen by."""

    def renumbered(self, row_of_frame: Int[Tensor, " f"]) -> Observations:
        """Those of the frames that have a row, by rows; -1: the frame has none."""
        corner, point = row_of_frame[self.corners.frame], row_of_frame[self.lane_points.frame]
        of_corner, of_point = corner >= 0, point >= 0
        return Observations(
            replace(self.corners[of_corner], frame=corner[of_corner]),
            replace(self.lane_points[of_point], frame=point[of_point]),
            self.matches[of_point],
            self.lenses,
        )


@dataclass(frozen=True)
class Priors:
    """What is known of them before."""

    poses: PosePrior
    fixed: dict[str, CostTerm]
    """Of signs and lanes: terms that stay as they are."""
    beside: Int[Tensor, " c"]
    """The pose nearest to each lane coefficient at the start; -1: it is another's."""
    fleet: Fleet
    """What cars have wrong for good."""
    course: Course | None
    """What the way of cars says; None: nothing is asked of it."""


@dataclass(frozen=True)
class SharedOut:
    """Some of all drives, and who has the others."""

    together: Together
    plan: EliminationPlan
    """What is eliminated of them, and how; landmarks are ranked as in all drives' plan."""
    detections: int
    """How many numbers detections have, everybody's."""
