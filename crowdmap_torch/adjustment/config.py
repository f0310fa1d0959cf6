"""What bundle adjustment can be told (V-B)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from crowdmap_torch.noise.pose_prior import PosePriorConfig
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.ranges import (
    Count,
    CountOrNone,
    Deviations,
    Factor,
    Length,
    LengthOrNone,
    Pixels,
    Range,
    Settings,
    Sigma,
    SigmaOrNone,
    SigmaOrOff,
    Spacing,
)
from crowdmap_torch.residuals.sign_prior import SignHabit
from crowdmap_torch.road.nonholonomic import NonholonomicConfig

METHODS = ("joint", "paper2017")
JACOBIANS = ("closed", "autograd")


@dataclass(frozen=True)
class CourseConfig(Settings):
    """What the way that a car takes says of its poses' errors."""

    reach_m: LengthOrNone = 8.0
    """Stretches of the drift are bound by it where they are less than this apart; 0: none are."""
    nonholonomic: NonholonomicConfig = field(default_factory=NonholonomicConfig)
    """How far cars hold that constraint."""
    slip_sigma_rad: Sigma = 0.03
    """1-sigma of the angle between the camera's axis and the car's, beyond what poses show of it."""
    lever_sigma_m: Sigma = 1.0
    """1-sigma of the distance of the camera from the axle that does not steer, likewise."""
    tukey_c: Deviations = 6.0
    """Where a car parts from where it points by more standard deviations than this, it says nothing: positions may leap."""


@dataclass(frozen=True)
class AdjustConfig(Settings):
    """Bundle adjustment (V-B)."""

    method: str = "joint"
    """`joint`: detections stand or fall as a whole, corners of small boxes and lane points weigh what their own residuals
    say. `paper2017`: eq:ba with Tukey's weights of every corner and lane point by itself, all pixels weighed alike."""
    lm: lm.LmConfig = field(
        default_factory=lambda: lm.LmConfig(
            max_iterations=30,
            cost_tolerance=5e-5,
            move_tolerance=0.05,
            initial_damping=1e-9,
            max_stretch=3.0,
            corrections=8,
        )
    )
    """The solver; its tolerances count once the scales stand still."""
    jacobians: str = "closed"
    """`autograd`: of every residual by autograd and the chain rule; `closed`: in closed form where there is one, which is
    faster and the same."""
    prior: PosePriorConfig = field(default_factory=PosePriorConfig)
    """What the poses may be wrong by."""
    course: CourseConfig = field(default_factory=CourseConfig)
    """What the way that a car takes says of them; method `joint`."""
    tukey_c: Deviations = 4.685
    """Residuals beyond this many standard deviations have no weight; the corners of a detection are judged together, by a
    bound that is as efficient."""
    sign_sigma_px: Pixels = 0.5
    """Least standard deviation of a sign corner of a large box; more where the residuals say so. Method `paper2017`: of
    any pixel."""
    box_sigma: SigmaOrNone = 0.5
    """Noise of the sides of detections that are axis-aligned boxes, drawn around a sign, or have their shape drawn into one,
    as a share of them; 0: boxes are taken for outlines."""
    habit: SignHabit = field(default_factory=SignHabit)
    """What signs are like before anything is seen of them."""
    size_classes_m: tuple[tuple[Length, Length], ...] = ()
    """Widths and heights that signs are made in: one that is near such a size is drawn to it, others are not. None: sizes
    are what the images say."""
    size_class_sigma: Sigma = 0.005
    """1-sigma of the width and height of signs about their class, as a share."""
    innovation_chance: Annotated[float, Range(0, 0.99, "a chance: at 1 all detections go")] = 1e-5
    """Detections further from what everything else foresees than normal noise brings them with this chance are given up;
    0: none."""
    lane_sigma_px: Pixels = 0.8
    """Least standard deviation of a lane point across the marker."""
    lane_correlation: Factor = 1.0
    """Least factor on the lane points' sigma, as the points of one detection err together; more where the residuals
    say so."""
    lane_height_sigma_m: SigmaOrOff = 0.05
    """How well the road under the car tells a marker's height."""
    lane_gate_m: Length = 0.9
    """Lane points further from every lane than this, before adjustment, are left out."""
    lane_step_sigma_m: tuple[Sigma, Sigma, Sigma] = (0.2, 0.5, 0.3)
    """How much the step from one control point to the next may change: along the marker, across it, upwards."""
    lane_place_sigma_m: Sigma = 30.0
    """Prior of a control point's place: only there to keep a marker that nothing holds."""
    lane_slide_m: Length = 0.3
    """How far a control point may about slide along its marker in one step of the solver."""
    drift_spacing_m: Spacing = 1.0
    """Stretch over which the drift of the poses is taken to stand still."""
    keyframe_spacing_m: Spacing = 3.0
    """Lane points are taken from frames this far apart."""
    points_per_detection: Count = 5
    """Most points of a lane detection that are used."""
    max_ground_distance_m: LengthOrNone = 25.0
    """Lane points that meet the road further ahead are left out."""
    frame_spacing_m: Spacing = 0.25
    """Frames closer together than this (a car at a light) are thinned."""
    cut_unknowns: CountOrNone = 800
    """Drives over a larger map are cut into stretches along which signs and lanes have at most about so many unknowns, fewer
    where few drives pass, and solved for between the cuts: time and memory grow with the way driven, no faster. 0: none
    is. The map is the same."""
    convoy_m: LengthOrNone = 50_000.0
    """Where twice as much way was driven and more, drives are adjusted in convoys of about so much or more, wherever there
    are workers for them; 0: all in one. The map is the same but for rounding, and with any workers to the last bit."""
    influence: bool = False
    """Whether it is told what the map would be without each of the drives: about as long as two steps, and a factor of the
    map for every drive."""

    def __post_init__(self) -> None:
        """Refuses unknown methods and Jacobians."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")
        if self.jacobians not in JACOBIANS:
            raise ValueError(
                f"jacobians: expected one of {', '.join(JACOBIANS)}, found {self.jacobians!r}"
            )
