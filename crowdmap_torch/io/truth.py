"""The truth of a simulated dataset: scorers read it, the mapper never does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.columns import MAX_PLACE_M, Sheet
from crowdmap_torch.io.datasets import row_count
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.rigs import UNIT_TOLERANCE
from crowdmap_torch.tables import Journey, Rows, Survey

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class JourneyTruth:
    """The truth of one journey, aligned with the frames of its table and the rows of its files."""

    journey: Journey
    """As the mapper sees it."""
    T_world_camera: Float[Tensor, "f 4 4"]
    """True poses of the camera."""
    sign: Int[Tensor, " r"]
    """For each row of signs.parquet the survey's sign it shows; -1 for a false detection."""
    sign_frame: Int[Tensor, " r"]
    """Frame index of each row of signs.parquet; -1 where the row was dropped at the door."""
    sign_outlier: Bool[Tensor, " r"]
    """True where the detection's geometry is grossly wrong."""
    lane: Int[Tensor, " q"]
    """For each row of lanes.parquet the survey's lane it shows; -1 for a false detection."""
    road_normal_camera: Float[Tensor, "f 3"]
    """True unit normal from the camera towards the road."""
    camera_height: Float[Tensor, " f"]
    """True distance from the camera centre to the road plane [m]."""

    @property
    def T_true_given(self) -> Float[Tensor, "f 4 4"]:
        """What takes the error of a frame's pose off a world point."""
        return self.T_world_camera @ se3.inverse(self.journey.T_world_camera)

    @property
    def way_m(self) -> Float[Tensor, " s"]:
        """How far the camera really moved between successive frames."""
        p = self.T_world_camera[:, :3, 3]
        return (p[1:] - p[:-1]).norm(dim=1)

    @property
    def mean_error_m(self) -> Float[Tensor, " 3"]:
        """Given minus true positions, the mean along the way; at a standstill, over the frames."""
        error = self.journey.T_world_camera[:, :3, 3] - self.T_world_camera[:, :3, 3]
        pad = torch.nn.functional.pad
        # Half a step belongs to either of its ends.
        weight = pad(self.way_m, (0, 1)) + pad(self.way_m, (1, 0)) + 1e-9
        return weight @ error / weight.sum()


@dataclass(frozen=True)
class Truth:
    """The truth of the journeys in use."""

    journeys: tuple[JourneyTruth, ...]

    def select(self, journey_ids: Iterable[str]) -> Truth:
        """Only the journeys named."""
        wanted = set(journey_ids)
        return replace(
            self, journeys=tuple(t for t in self.journeys if t.journey.journey_id in wanted)
        )


def has_truth(survey_folder: Path) -> bool:
    """True if a survey comes with the truth of a simulation."""
    return (survey_folder / "truth").is_dir()


def read_truth(survey_folder: Path, survey: Survey, journeys: Sequence[Journey]) -> Truth:
    """The truth of `journeys` from `survey/truth/`; ValueError if it does not fit them."""
    return Truth(
        journeys=tuple(
            _read_journey_truth(survey_folder / "truth" / j.journey_id, survey, j) for j in journeys
        )
    )


def _read_journey_truth(folder: Path, survey: Survey, journey: Journey) -> JourneyTruth:
    like = journey.T_world_camera
    pose = _of_frames(folder / "poses.parquet", _POSE, journey)
    T_world_link = se3.make(se3.from_quaternion(pose[:, 3:]), pose[:, :3]).to(like)
    plane = _of_frames(folder / "road.parquet", ("nx", "ny", "nz", "height_m"), journey).to(like)
    _refuse_off(folder / "poses.parquet", "quaternion", pose[:, 3:])
    _refuse_off(folder / "road.parquet", "normal", plane[:, :3])
    rows = {kind: row_count(journey, kind) for kind in ("sign", "lane")}
    sign, outlier = _read_labels(folder / "signs.parquet", "sign_id", survey.sign_id, rows["sign"])
    lane, _ = _read_labels(folder / "lanes.parquet", "lane_id", survey.lane_id, rows["lane"])
    frame = torch.full((len(sign),), -1, dtype=torch.int64)
    frame[journey.signs.row.cpu()] = journey.signs.frame.cpu()
    return JourneyTruth(
        journey=journey,
        T_world_camera=T_world_link @ journey.rig.T_link_camera,
        sign=sign.to(like.device),
        sign_frame=frame.to(like.device),
        sign_outlier=outlier.to(like.device),
        lane=lane.to(like.device),
        road_normal_camera=plane[:, :3],
        camera_height=plane[:, 3],
    )


def _of_frames(path: Path, columns: Sequence[str], journey: Journey) -> Float[Tensor, "f k"]:
    """Columns of a file with a row for each frame, in the order of the journey's frames."""
    sheet = Sheet(path, ("frame", *columns))
    numbers = [sheet.numbers(name) for name in columns]
    for name, of_name in zip(columns, numbers, strict=True):
        sheet.refuse(
            np.abs(of_name) > MAX_PLACE_M,
            lambda row, name=name, found=of_name: (
                f"column {name!r}: expected {MAX_PLACE_M:g} m at most, found {found[row]}"
            ),
        )
    values = torch.from_numpy(np.stack(numbers, axis=-1))
    frame = torch.from_numpy(sheet.integers("frame"))
    order = frame.argsort()
    wanted = journey.frame_number.cpu()
    place = torch.searchsorted(frame[order], wanted).clamp_max(max(len(frame) - 1, 0))
    if len(wanted) and (len(frame) == 0 or not bool((frame[order][place] == wanted).all())):
        raise sheet.fault(f"frames of journey {journey.journey_id} are missing")
    return values[order[place]]


def _refuse_off(path: Path, name: str, vector: Float[Tensor, "f k"]) -> None:
    """Refuses vectors that should have length one."""
    off = (vector.norm(dim=-1) - 1).abs().gt(UNIT_TOLERANCE)
    if bool(off.any()):
        length = float(vector[off][0].norm())
        raise InputError(f"{path}: a {name} has length {length:.6g}; expected 1")


def _read_labels(
    path: Path, column: str, ids: Sequence[str], least: int
) -> tuple[Int[Tensor, " r"], Bool[Tensor, " r"]]:
    """For each row of a detection file what it shows (-1 none), and whether it is an outlier."""
    sheet = Sheet(path, ("row", column), ("outlier",))
    rows_given = sheet.integers("row")
    if len(sheet) < least:
        raise sheet.fault(
            f"{len(sheet)} rows, but the journey's {path.name} has {least}; expected a line for each "
            "row. Is it another dataset's truth?"
        )
    sheet.refuse(
        np.sort(rows_given) != np.arange(len(sheet)),
        lambda at: f"column 'row': expected each of 0 to {len(sheet) - 1} once",
    )
    row = torch.from_numpy(rows_given)
    names = sheet.strings(column, optional=True)
    label = index_in(names, ids)
    sheet.refuse(
        names.is_valid().to_numpy(zero_copy_only=False) & (label < 0).numpy(),
        lambda at: f"{column} {names[at].as_py()!r} is not in the survey",
    )
    rows = int(row.max()) + 1 if len(row) else 0
    outlier = torch.from_numpy(sheet.flags("outlier"))
    return (
        torch.full((rows,), -1, dtype=torch.int64).index_put((row,), label),
        torch.zeros(rows, dtype=torch.bool).index_put((row,), outlier),
    )


def index_in(names: pa.StringArray, ids: Sequence[str]) -> Int[Tensor, " n"]:
    """The index in `ids` of each string; -1 for null and for other strings."""
    place = {name: index for index, name in enumerate(ids)}
    encoded = names.dictionary_encode()
    code = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int64)
    # One entry more for null, which has the code -1.
    of_code = [place.get(name, -1) for name in encoded.dictionary.to_pylist()]
    return torch.tensor([*of_code, -1], dtype=torch.int64)[torch.as_tensor(code)]


@dataclass(frozen=True)
class SignAssociations(Rows):
    """Rows of the journeys' signs files that are in a landmark of a map."""

    journey: Int[Tensor, " a"]
    """Index into the journey ids that were asked for."""
    row: Int[Tensor, " a"]
    landmark: Int[Tensor, " a"]
    """Landmarks numbered from 0."""


def read_associations(path: Path, journey_ids: Sequence[str]) -> SignAssociations:
    """The sign rows of RUN/associations.parquet that are in a landmark, of the journeys named."""
    sheet = Sheet(path, ("journey_id", "kind", "row", "landmark_id"))
    journey = index_in(sheet.strings("journey_id"), journey_ids)
    names = sheet.strings("landmark_id", optional=True)
    landmark = index_in(names, [name for name in names.unique().to_pylist() if name is not None])
    given = sheet.integers("row")
    sheet.refuse(given < 0, lambda at: f"column 'row': expected 0 or more, found {given[at]}")
    row = torch.from_numpy(given)
    is_sign = index_in(sheet.strings("kind"), ("sign",)) == 0
    return SignAssociations(journey, row, landmark)[is_sign & (journey >= 0) & (landmark >= 0)]
