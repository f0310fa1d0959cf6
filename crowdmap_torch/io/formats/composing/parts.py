"""What importers give: parts of a data set, each in the conventions of its format; and what the command line asks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.tables import Origin


@dataclass(frozen=True)
class Track:
    """Poses along a drive, in order of time."""

    source: Path
    """The file that complaints name."""
    t_ns: Int[np.ndarray, " n"]
    T_world_link: Float[np.ndarray, "n 4 4"]
    world: str | None = "enu"
    """Axes of the file's world, a key of `axes.WORLDS`; None where the format leaves them to its writer."""
    link: str | None = "mount"
    """Axes of the link whose poses these are, a key of `axes.LINKS`, or `mount` for the link that the rig's mount names.

    None where the format leaves them to its writer."""
    frame_number: Int[np.ndarray, " n"] | None = None
    """Numbers of camera frames, if the rows are those; None counts rows."""
    sigma_position: Float[np.ndarray, "n 3"] | None = None
    """1-sigma, east north up [m]."""
    sigma_rotation: Float[np.ndarray, " n"] | None = None
    """1-sigma about each axis [rad]."""


@dataclass(frozen=True)
class CarRig:
    """A camera on a car as a log describes it."""

    rig_id: str
    camera: Camera
    T_link_camera: Float[np.ndarray, "4 4"]
    """The camera in the link of the log's poses; the identity where they are the camera's own."""
    road_normal_camera: Float[np.ndarray, " 3"] | None = None
    """Unit normal from the camera towards the road; None: the link's z axis is the road's."""
    camera_height: float | None = None
    """Of the camera over the road [m]; None where the log does not say."""


@dataclass(frozen=True)
class SignRows:
    """Signs detected in images."""

    source: Path
    images: tuple[str, ...]
    """Every image that the file lists, in its order, whether anything was seen there or not."""
    image: Int[np.ndarray, " n"]
    """Index into `images`."""
    shape: Int[np.ndarray, " n"]
    """Index into `polygon.SHAPES`."""
    corners_px: Float[np.ndarray, "n 8 2"]
    """As FORMAT.md has pixels; slots past the shape's number of corners repeat the last one."""
    code: tuple[str | None, ...]
    """Traffic-sign codes."""
    score: Float[np.ndarray, " n"]
    """0 to 1; NaN unknown."""
    track: Int[np.ndarray, " n"]
    """-1 none."""
    size_px: tuple[int, int] | None = None
    """Width and height of the images, if the file says them."""
    sizes_m: tuple[tuple[float, float], ...] = ()
    """Widths and heights in which the signs of these names are made."""


@dataclass(frozen=True)
class LaneRows:
    """Lane markers detected in images."""

    source: Path
    images: tuple[str, ...]
    image: Int[np.ndarray, " n"]
    count: Int[np.ndarray, " n"]
    """Points of each, two at least."""
    px: Float[np.ndarray, "p 2"]
    type: Int[np.ndarray, " n"]
    """Index into `tables.LANE_TYPES`; -1 unknown."""
    score: Float[np.ndarray, " n"]
    size_px: tuple[int, int] | None = None


@dataclass(frozen=True)
class SurveyRows:
    """Lane markers and signs whose place is known, in the world at the origin [m]."""

    source: Path
    lane_id: tuple[str, ...]
    lane_type: Int[np.ndarray, " n"]
    """Index into `tables.LANE_TYPES`; -1 unknown."""
    lane_points: tuple[Float[np.ndarray, "_ 3"], ...]
    """Two points at least of each."""
    sign_id: tuple[str, ...]
    sign_shape: Int[np.ndarray, " m"]
    """Index into `polygon.SHAPES`."""
    sign_code: tuple[str | None, ...]
    sign_corners: tuple[Float[np.ndarray, "_ 3"], ...]
    """Clockwise as the driver sees them; a single point is the centre of a sign whose corners are not known."""


@dataclass(frozen=True)
class Parts:
    """What one source gives; None for what it does not have."""

    track: Track | None = None
    rig: CarRig | None = None
    signs: SignRows | None = None
    lanes: LaneRows | None = None
    survey: SurveyRows | None = None
    origin: Origin | None = None
    """Where the world of the track and the survey touches the earth."""
    notes: tuple[str, ...] = ()
    """What was left out, and why, a line each."""


@dataclass(frozen=True)
class Asked:
    """What the command line says of the sources; None where it says nothing."""

    origin: Origin | None = None
    world: str | None = None
    link: str | None = None
    camera_at: tuple[float, float, float] | None = None
    """Place of the camera in the link's axes [m]."""
    images: str | None = None
    """How an image's name says which frame it is: see `frames`."""
    first_frame: int = 0
    time_offset_s: float = 0.0
    """Added to the images' times to make them the poses'."""
    sign_names: Path | None = None
    """A table of names beside the package's own."""
    skip_unknown_signs: bool = False
    drive: str | None = None
    """The drive of a source with several."""
    camera: str | None = None
    """The sensor of a log with several."""
    camera_height: float | None = None
    """Of the camera over the road [m], where a log does not say it."""
    heading: str | None = None
    """`course`: the direction of travel stands for the heading that fixes do not have."""
    pixel_origin: str | None = None
    """`centre` or `corner` of the first pixel, where (0, 0) is in the detections' files."""


@dataclass(frozen=True)
class Importer:
    """A format that can be read."""

    summary: str
    """What it is, in a line."""
    gives: tuple[str, ...]
    """Which of `poses`, `rig`, `signs`, `lanes`, `survey`."""
    tested_on: str
    """`real files`, or `small files after the published layout`."""
    read: Callable[[tuple[Path, ...], Asked], Parts]
    """Reads the files of one `--from`; InputError names the file, the row and the rule."""
