"""IV-A, signs: what association needs of detections, and the epipolar costs of pairs: batched, whatever the frame."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import correspondence, polygon, se3
from crowdmap_torch.geometry.epipolar import fundamental, fundamental_of_motion
from crowdmap_torch.ranges import Cost, Count, Deviations, Length, Pixels, Settings, Sigma
from crowdmap_torch.tables import Rows, SignDetections

METHODS = ("predicted", "paper2017")
CLEAR_ORDER = 0.5
"""The corner order is clear where it misses the template by less than this share of what the second best order does."""


@dataclass(frozen=True)
class PaperSignAssociation(Settings):
    """What the paper leaves open of its association of signs (IV-A)."""

    window_frames: Count = 10
    """Association window w: tracklets silent for longer are ignored [frames]."""
    max_cost_px2: Cost = 144.0
    """A detection whose cost, summed over vertices, exceeds this with every tracklet starts one [px^2]."""


@dataclass(frozen=True)
class SignAssociationConfig(Settings):
    """How sign detections are linked across frames (IV-A)."""

    method: str = "predicted"
    """`predicted`: the epipolar cost to the last measurement, and the distance to where the tracklet is predicted to appear
    and how large; `paper2017`: the epipolar cost as printed, summed over vertices, and nothing else."""
    paper: PaperSignAssociation = field(default_factory=PaperSignAssociation)
    """Method `paper2017`; all that follows is of `predicted`."""
    window_frames: Count = 25
    """Association window w: tracklets silent for longer are ignored [frames]."""
    max_epipolar_px: Pixels = 6.0
    """A detection starts a new tracklet where the root mean epipolar cost over vertices exceeds this [px]."""
    max_distance: Deviations = 5.0
    """... or where it is this many standard deviations from every prediction: implausible motion."""
    unmatched_cost: Cost = 24.0
    """What leaving a detection and a tracklet unmatched costs, as minus twice a log-likelihood."""
    sure_after: Count = 3
    """From so many measurements on, a tracklet that agrees with its prediction may break the epipolar gate: the last
    measurement may have been the wrong one."""
    shape_penalty: Cost = 6.0
    """Added to the cost where a detection's shape is not the tracklet's shape by vote."""
    young_penalty: Cost = 4.0
    """Added to the cost of a tracklet with one measurement, half of it with two, and so on: of two tracklets of one sign,
    one begun by a second detection in a frame, the older goes on."""
    track_bonus: Cost = 2.0
    """Taken off where the perception module's track number agrees: a hint, which may be wrong."""
    sigma_px: Pixels = 1.0
    """Noise of a sign's centre and of half its height [px]."""
    sigma_relative: Sigma = 0.04
    """Further noise of the two, as a share of the sign's height."""
    typical_height_m: Length = 0.75
    """Median height of signs; gives a new tracklet its first depth."""
    sigma_log_height: Sigma = 0.7
    """Spread of the logarithm of the height of signs."""
    min_depth_m: Length = 1.0
    """Tracklets predicted nearer than this, or behind the camera, are not matched."""
    max_depth_m: Length = 500.0
    """Nor are those whose depth would exceed this."""
    chunk_pairs: Count = 1 << 13
    """Pairs whose costs are computed at once; bounds the memory. Of both methods, as the noise of sightings is."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"sign association method {self.method!r}; expected one of {METHODS}")

    @property
    def window(self) -> int:
        """The association window of the method [frames]."""
        return self.paper.window_frames if self.method == "paper2017" else self.window_frames


@dataclass(frozen=True)
class SignFeatures(Rows):
    """What association needs of detections, computed ahead for all of them."""

    frame: Int[Tensor, " d"]
    shape: Int[Tensor, " d"]
    track: Int[Tensor, " d"]
    corners: Float[Tensor, "d 8 2"]
    """Ideal coordinates."""
    box: Float[Tensor, "d 4 2"]
    """Axis-aligned box of the corners: what detections of different shapes have in common."""
    sighting: Float[Tensor, "d 3"]
    """Centre of the box and logarithm of its height, ideal coordinates."""
    variance: Float[Tensor, "d 3"]
    """Noise of `sighting`."""
    focal: Float[Tensor, " d"]
    """Pixels per unit of the plane z = 1 at the detection: the local focal length, distortion included."""
    outline: Float[Tensor, "d 8 2"]
    """Corners relative to the box's centre, in units of its width and height; v down."""
    shift: Int[Tensor, " d"]
    """Cyclic order in which the outline is most like an upright sign of its shape."""
    clear: Bool[Tensor, " d"]
    """True where no other cyclic order is nearly as good."""
    T_world_camera: Float[Tensor, "d 4 4"]


@dataclass(frozen=True)
class SignFeatureArrays:
    """Those columns of `SignFeatures` that the causal loop reads, as NumPy's arrays."""

    frame: Int[np.ndarray, " d"]
    shape: Int[np.ndarray, " d"]
    track: Int[np.ndarray, " d"]
    sighting: Float[np.ndarray, "d 3"]
    variance: Float[np.ndarray, "d 3"]
    focal: Float[np.ndarray, " d"]
    outline: Float[np.ndarray, "d 8 2"]
    shift: Int[np.ndarray, " d"]
    clear: Bool[np.ndarray, " d"]
    T_world_camera: Float[np.ndarray, "d 4 4"]

    @classmethod
    def of(cls, features: SignFeatures) -> SignFeatureArrays:
        """Views of a table that is on the CPU."""
        return cls(*(getattr(features, f.name).numpy() for f in fields(cls)))


def sign_features(
    detections: SignDetections,
    T_world_camera: Float[Tensor, "d 4 4"],
    config: SignAssociationConfig,
) -> SignFeatures:
    """Features of detections whose frames have the poses `T_world_camera`."""
    corners = detections.corners_ideal
    low, high = corners.amin(1), corners.amax(1)
    box = torch.stack(
        (
            low,
            torch.stack((high[:, 0], low[:, 1]), -1),
            high,
            torch.stack((low[:, 0], high[:, 1]), -1),
        ),
        dim=1,
    )
    extent_px = detections.corners_px.amax(1) - detections.corners_px.amin(1)
    extent = (high - low).clamp_min(1e-12)
    focal = (extent_px.clamp_min(1e-6) / extent).log().mean(-1).exp()
    sigma_px = (config.sigma_px**2 + (config.sigma_relative * extent_px[:, 1]).square()).sqrt()
    sigma_centre = sigma_px / focal
    sigma_log_height = 2 * sigma_px / extent_px[:, 1].clamp_min(1.0)
    outline = (corners - (low + high)[:, None] / 2) / extent[:, None]
    count = polygon.corner_count(detections.shape)
    template = _template_outlines().to(corners)[detections.shape]
    shift, best, second = correspondence.clearest_order(outline, template, count)
    sighting = torch.cat(((low + high) / 2, extent[:, 1:].log()), dim=-1)
    variance = torch.stack((sigma_centre, sigma_centre, sigma_log_height), dim=-1).square()
    return SignFeatures(
        frame=detections.frame,
        shape=detections.shape,
        track=detections.track,
        corners=corners,
        box=box,
        sighting=sighting,
        variance=variance,
        focal=focal,
        outline=outline,
        shift=shift,
        clear=best < CLEAR_ORDER * second,
        T_world_camera=T_world_camera,
    )


def sign_pair_costs(
    a: SignFeatures, b: SignFeatures, config: SignAssociationConfig
) -> Float[Tensor, " p"]:
    """The cost of linking each detection of `a` with the later one of `b` in the same row [px^2] (IV-A)."""
    costs = _printed_costs if config.method == "paper2017" else _blended_costs
    return costs(a, b, config)


def _printed_costs(
    a: SignFeatures, b: SignFeatures, config: SignAssociationConfig
) -> Float[Tensor, " p"]:
    """The epipolar cost as the paper prints it, summed over the best matching of vertices (IV-A, Cost for sign association).

    Detections of different shapes have none: the paper does not say what the sum is where vertices are left over.
    """
    F_ab = fundamental(a.T_world_camera, b.T_world_camera)
    cost = torch.full_like(a.focal, torch.inf)
    kind = torch.where(a.shape == b.shape, polygon.corner_count(a.shape), 0)
    for n in kind[kind > 0].unique().tolist():
        at = (kind == n).nonzero()[:, 0]
        p, q = a.corners[at, :n], b.corners[at, :n]
        vertex = correspondence.vertex_costs(F_ab[at], p, q, components=3)
        cost[at] = correspondence.free_assignment(vertex) * a.focal[at] * b.focal[at]
    return cost


def _blended_costs(
    a: SignFeatures, b: SignFeatures, config: SignAssociationConfig
) -> Float[Tensor, " p"]:
    """The epipolar cost of pairs of detections, mean over vertices [px^2] (IV-A, Cost for sign association).

    Vertices are matched in the best cyclic order; detections of different shapes are compared by their boxes. Where the
    baseline is too short to move a sign of typical size by more than the noise, the epipolar lines say nothing, and the
    rotation-compensated pixel distance takes over. Unlike the paper, the norm is Sampson's, whose cost is a distance in
    pixels wherever the epipolar line is, and the mean over vertices lets one threshold serve all shapes.
    """
    T_a_b = se3.inverse(a.T_world_camera) @ b.T_world_camera
    F_ab = fundamental_of_motion(T_a_b)
    height_px = (a.sighting[:, 2].exp() * a.focal + b.sighting[:, 2].exp() * b.focal) / 2
    motion_px = T_a_b[:, :3, 3].norm(dim=-1) * height_px / config.typical_height_m
    noise_sq = 4 * config.sigma_px**2
    epipolar_share = motion_px.square() / (motion_px.square() + noise_sq)
    scale = a.focal * b.focal
    same = a.shape == b.shape
    kind = torch.where(same, polygon.corner_count(a.shape), 0)
    cost = torch.full_like(scale, torch.inf)
    for corners in kind.unique().tolist():
        at = (kind == corners).nonzero()[:, 0]
        p, q = (a.corners, b.corners) if corners else (a.box, b.box)
        n = corners or p.shape[1]
        p, q = p[at, :n], q[at, :n]
        share = epipolar_share[at, None, None]
        moved = correspondence.rotation_compensated(T_a_b[at, :3, :3], p, q)
        # A point behind the other camera is infinitely far: the share of an infinite cost must not become NaN.
        moved = torch.where(share < 1, (1 - share) * moved, torch.zeros_like(moved))
        vertex = share * correspondence.vertex_costs(F_ab[at], p, q) + moved
        if corners == 0:
            total = vertex.diagonal(dim1=-2, dim2=-1).sum(-1)
        else:
            total = correspondence.cyclic_sums(vertex).amin(-1)
        cost[at] = total * scale[at] / n
    return cost


def _template_outlines() -> Float[Tensor, "s 8 2"]:
    """The outline of every shape's template, as `SignFeatures.outline` has it."""
    corners = polygon.template(torch.arange(len(polygon.SHAPES))).to(torch.float64)
    low, high = corners.amin(1, keepdim=True), corners.amax(1, keepdim=True)
    # The template's second axis points up, the image's down.
    return (corners - (low + high) / 2) / (high - low) * corners.new_tensor([1.0, -1.0])
