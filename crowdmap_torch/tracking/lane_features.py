"""IV-A, lanes: what association needs of detections, and the costs of pairs: batched, whatever the frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.correspondence import vertex_costs
from crowdmap_torch.geometry.epipolar import fundamental
from crowdmap_torch.ranges import Cost, Count, Factor, Length, Settings, Sigma, Span
from crowdmap_torch.tables import LaneDetections, LanePoints, Rig, Rows, concatenate

METHODS = ("ground", "paper2017")
SAMPLES = 6
"""Points by which a detection's line is compared, each with each of the other's where the method is the paper's."""


@dataclass(frozen=True)
class PaperLaneAssociation(Settings):
    """What the paper leaves open of its association of lanes (IV-A)."""

    window_frames: Count = 25
    """Association window w: tracklets silent for longer are ignored [frames]."""
    max_cost_px2: Cost = 5184.0
    """A detection whose cost, summed over pairs of points, exceeds this with every tracklet starts one: 12 px for each of
    36 pairs [px^2]."""


@dataclass(frozen=True)
class LaneAssociationConfig(Settings):
    """How lane detections become tracklets (IV-A)."""

    method: str = "ground"
    """`ground`: sideways distance on the calibrated road plane; `paper2017`: the epipolar cost of the line's
    image as printed."""
    paper: PaperLaneAssociation = field(default_factory=PaperLaneAssociation)
    """Method `paper2017`; all that follows is of `ground`."""
    window_frames: Count = 25
    """Tracklets silent for longer are ignored: the association window."""
    unmatched_cost: Cost = 9.0
    """A detection that costs more, mean square in standard deviations, starts a tracklet."""
    sigma_m: Sigma = 0.2
    """Sideways noise of a line near the car."""
    sigma_per_m: Factor = 0.012
    """Growth of that noise with the distance ahead."""
    turn_sigma_per_m: Factor = 0.03
    """Growth of the noise beyond the end of the line that is compared with."""
    max_beyond_m: Length = 25.0
    """Lines with a longer gap between them, along the road, are not compared."""
    type_penalty: Cost = 2.0
    """Cost of another type where both are known."""
    reach_m: Span = (2.0, 45.0)
    """Points nearer or further ahead on the road plane are left out."""
    chunk_pairs: Count = 1 << 13
    """Pairs whose costs are computed at once; method `paper2017`."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")

    @property
    def window(self) -> int:
        """The association window of the method [frames]."""
        return self.paper.window_frames if self.method == "paper2017" else self.window_frames


@dataclass(frozen=True)
class LaneFeatures(Rows):
    """What association needs of each lane detection."""

    frame: Int[Tensor, " d"]
    type: Int[Tensor, " d"]
    curve: Float[Tensor, "d 3"]
    """Sideways place `c0 + c1 x + c2 x^2` on the road plane, x metres ahead; left is positive."""
    extent: Float[Tensor, "d 2"]
    """Nearest and furthest x."""
    T_world_road: Float[Tensor, "d 4 4"]
    """Road frame: under the camera, x ahead, y left, z up."""
    line_ideal: Float[Tensor, "d s 2"]
    """Samples of the straight line through the detection's image points, on the plane z = 1; but for method `paper2017`
    none."""
    focal: Float[Tensor, " d"]
    T_world_camera: Float[Tensor, "d 4 4"]


def lane_features(
    detections: LaneDetections,
    points: LanePoints,
    rig: Rig,
    T_world_camera: Float[Tensor, "d 4 4"],
    config: LaneAssociationConfig,
) -> LaneFeatures:
    """Lines through lane detections, on the calibrated road plane and in the image."""
    T_camera_road = _road_axes(rig)
    ray = torch.nn.functional.pad(points.ideal, (0, 1), value=1.0)
    ray_road = ray @ T_camera_road[:3, :3]
    below = -ray_road[:, 2]
    depth = rig.camera_height / below.clamp_min(1e-4)
    x, y = (ray_road[:, :2] * depth[:, None]).unbind(-1)
    near, far = config.reach_m
    on_road = (below > 1e-4) & (x > near) & (x < far)
    # A pixel at x metres is x^2 / (f h) metres along the road, and aside in the same proportion.
    sigma = config.sigma_m + config.sigma_per_m * x.clamp(near, far)
    count = len(detections)
    curve, extent = _fit_curves(
        x[on_road], y[on_road], sigma[on_road], points.detection[on_road], count
    )
    focal = rig.camera.K[0, 0].expand(count)
    return LaneFeatures(
        frame=detections.frame,
        type=detections.type,
        curve=curve,
        extent=extent,
        T_world_road=T_world_camera @ T_camera_road,
        line_ideal=_image_lines(points, count)
        if config.method == "paper2017"
        else points.ideal.new_zeros(count, 0, 2),
        focal=focal,
        T_world_camera=T_world_camera,
    )


def _road_axes(rig: Rig) -> Float[Tensor, "4 4"]:
    """`T_camera_road` of the calibrated road: its origin under the camera, x ahead, y left, z up."""
    up = -rig.road_normal_camera
    ahead = torch.zeros_like(up)
    ahead[2] = 1
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    left = torch.linalg.cross(up, ahead)
    # Rays start at the camera: the frame's axes are the road's, its origin is the camera's.
    return se3.make(torch.stack((ahead, left, up), dim=-1), torch.zeros_like(up))


def lane_pair_costs(
    a: LaneFeatures, b: LaneFeatures, config: LaneAssociationConfig
) -> Float[Tensor, " p"]:
    """Cost of linking each lane detection of `a` with the later one of `b` in the same row."""
    if config.method == "paper2017":
        return _printed_costs(a, b)
    lines, first = GroundLines.of(concatenate((a, b)), config), np.arange(len(a))
    return torch.from_numpy(lines.costs(first, first + len(a), config)).to(a.focal)


@dataclass(frozen=True)
class GroundLines:
    """What costs on the road need of each detection, as NumPy's arrays.

    Few pairs are asked for in a frame, and all but those with active tracklets are never: computed when asked for they take
    a fourth of the time of all in the window ahead.
    """

    type: Int[np.ndarray, " d"]
    curve: Float[np.ndarray, "d 3 1"]
    extent: Float[np.ndarray, "d 2 1"]
    is_line: Bool[np.ndarray, " d"]
    place_world: Float[np.ndarray, "d 4 s"]
    """Places along the line, homogeneous."""
    sigma: Float[np.ndarray, "d s"]
    """Sideways noise there [m]."""
    plane_world: Float[np.ndarray, "d 2 4"]
    """What takes places to x ahead and y to the left on the detection's road."""

    @classmethod
    def of(cls, features: LaneFeatures, config: LaneAssociationConfig) -> GroundLines:
        """Of detections, wherever their tensors are."""
        share = torch.linspace(0, 1, SAMPLES).to(features.extent)
        near, far = features.extent[:, :1], features.extent[:, 1:]
        x = near + (far - near).clamp_max(25.0) * share
        c = features.curve[:, :, None]
        y = c[:, 0] + c[:, 1] * x + c[:, 2] * x.square()
        place_road = torch.stack((x, y, torch.zeros_like(x), torch.ones_like(x)), dim=1)
        sigma = config.sigma_m + config.sigma_per_m * x
        columns = (
            *(features.type, c, features.extent[:, :, None], features.extent[:, 1] > 0),
            *(features.T_world_road @ place_road, sigma),
            # The places are on the road's plane, and what matters of them in another frame is x and y.
            se3.inverse(features.T_world_road)[:, :2],
        )
        return cls(*(column.cpu().numpy() for column in columns))

    def costs(
        self,
        last: Int[np.ndarray, "*#pairs"],
        rows: Int[np.ndarray, "*#pairs"],
        config: LaneAssociationConfig,
    ) -> Float[np.ndarray, "*pairs"]:
        """Mean squared sideways distance of each later line from the earlier one, in standard deviations; and types."""
        seen = self.plane_world[last] @ self.place_world[rows]
        ahead, sideways = seen[..., 0, :], seen[..., 1, :]
        extent, curve = self.extent[last], self.curve[last]
        inside = np.minimum(np.maximum(ahead, extent[..., 0, :]), extent[..., 1, :])
        off_end = ahead - inside
        beyond = np.abs(off_end)
        # Beyond its ends the line goes on straight.
        bend = curve[..., 2, :] * inside
        slope = curve[..., 1, :] + 2 * bend
        expected = curve[..., 0, :] + (curve[..., 1, :] + bend) * inside + slope * off_end
        error = (sideways - expected) / (self.sigma[rows] + config.turn_sigma_per_m * beyond)
        usable = beyond < config.max_beyond_m
        count = usable.sum(-1)
        cost = (error * error * usable).sum(-1) / np.maximum(count, 1)
        before, now = self.type[last], self.type[rows]
        cost += config.type_penalty * ((before != now) & (before >= 0) & (now >= 0))
        cost[~(self.is_line[last] & self.is_line[rows] & (count > 0))] = np.inf
        return cost


def _printed_costs(a: LaneFeatures, b: LaneFeatures) -> Float[Tensor, " p"]:
    """The epipolar cost as printed, summed over all pairs of points of two lines (IV-A, Cost for lane association).

    A straight marker is its own epipolar line where the car goes along it: which point is which needs no answer.
    """
    F = fundamental(a.T_world_camera, b.T_world_camera)
    cost = vertex_costs(F, a.line_ideal, b.line_ideal, components=3)
    return cost.sum((-1, -2)) * a.focal * b.focal


def _fit_curves(
    x: Float[Tensor, " m"],
    y: Float[Tensor, " m"],
    sigma: Float[Tensor, " m"],
    detection: Int[Tensor, " m"],
    count: int,
) -> tuple[Float[Tensor, "d 3"], Float[Tensor, "d 2"]]:
    """Parabolas through the points of each detection, robust to outlier points, and the reach of their inliers."""
    # Rows last: every operation runs along them, and of the normal equations' nine sums five differ.
    powers = torch.stack((torch.ones_like(x), x, x.square(), x**3, x**4))
    place = torch.arange(3, device=x.device)
    # Markers go roughly ahead and bend with radii above some fifty metres.
    prior = torch.diag(1 / x.new_tensor([30.0, 0.5, 0.01]).square())
    weight = 1 / sigma.square()
    curve = x.new_zeros(count, 3)
    inlier = torch.ones_like(x, dtype=torch.bool)
    for iteration in range(6):
        products = torch.cat((weight * powers, weight * y * powers[:3]))
        sums = x.new_zeros(8, count).index_add_(1, detection, products).mT
        normal = prior + sums[:, place[:, None] + place]
        curve = torch.linalg.solve(normal, sums[:, 5:, None])[..., 0]
        at = curve.mT.index_select(1, detection)
        error = (at[0] + at[1] * x + at[2] * powers[2] - y).abs() / sigma
        # First the absolute error, then only what lies near the line.
        inlier = error < 3.0
        robust = 1 / error.clamp_min(0.5) if iteration < 4 else inlier.to(x)
        weight = robust / sigma.square()
    used = detection[inlier]
    nearest = x.new_full((count,), torch.inf).scatter_reduce(0, used, x[inlier], "amin")
    furthest = x.new_full((count,), -1.0).scatter_reduce(0, used, x[inlier], "amax")
    seen = furthest > 0
    nearest = torch.where(seen, nearest, -1.0)
    return curve, torch.stack((nearest, furthest), dim=-1)


def _image_lines(points: LanePoints, count: int) -> Float[Tensor, "d s 2"]:
    """Points spaced evenly along the line through the image points of each detection."""
    ideal, detection = points.ideal, points.detection
    number = torch.bincount(detection, minlength=count).clamp_min(1).to(ideal)[:, None]
    mean = ideal.new_zeros(count, 2).index_add_(0, detection, ideal) / number
    offset = ideal - mean[detection]
    scatter = ideal.new_zeros(count, 2, 2)
    scatter.index_add_(0, detection, offset[:, :, None] * offset[:, None])
    direction = torch.linalg.eigh(scatter).eigenvectors[..., 1]
    along = (offset * direction[detection]).sum(-1)
    low = ideal.new_zeros(count).scatter_reduce(0, detection, along, "amin")
    high = ideal.new_zeros(count).scatter_reduce(0, detection, along, "amax")
    # An eigenvector is free in sign: lines start at their lower end in the image.
    flip = direction[:, 1] < 0
    low, high = torch.where(flip, high, low), torch.where(flip, low, high)
    share = torch.linspace(0, 1, SAMPLES, dtype=ideal.dtype, device=ideal.device)
    place = low[:, None] + (high - low)[:, None] * share
    return mean[:, None] + place[..., None] * direction[:, None]
