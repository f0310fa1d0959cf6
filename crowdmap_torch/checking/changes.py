"""The changes of a data set's files that put mistakes right, one for each name of a `Repair`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml
from jaxtyping import Float, Int

from crowdmap_torch.checking.pose_changes import POSE_CHANGES
from crowdmap_torch.geometry.camera import distort
from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.copies import common_frames
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import read_json, read_yaml
from crowdmap_torch.io.writing import list_column, write_parquet
from crowdmap_torch.plausibility.finding import Repair
from crowdmap_torch.tables import Dataset, Journey

DETECTIONS = ("signs", "lanes")


@dataclass(frozen=True)
class Changed:
    """A change that was made."""

    place: str
    """The file or folder, seen from the data set's."""
    what: str


@dataclass(frozen=True)
class Task:
    """What is to be changed."""

    folder: Path
    """Of the data set."""
    journey: str
    repair: Repair
    file: str
    """The file that the finding is about, if it is one."""
    dataset: Dataset | None
    """The journeys as they are."""
    rigs_done: set[tuple[str, Repair]]
    """Rigs are changed once, whichever journeys they are of."""

    @property
    def place(self) -> str:
        """The journey's folder, seen from the data set's."""
        return f"journeys/{self.journey}"

    def path(self, name: str) -> Path:
        """A file of the journey."""
        return self.folder / "journeys" / self.journey / name


Change = Callable[[Task], Changed | None]
"""None: nothing was left to be changed."""
_Points = Float[np.ndarray, "p 2"]
_Counts = Int[np.ndarray, " n"]
_ChangePoints = Callable[[_Points, _Counts, Task], _Points]
"""Points of all rows, one row after the other, with how many each has, become others."""


def _write(path: Path, table: pa.Table) -> None:
    write_parquet(path, dict(zip(table.column_names, table.columns, strict=True)))


def _replaced(table: pa.Table, name: str, column: pa.Array | pa.ChunkedArray) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, column)


def _known(task: Task, name: str) -> Journey | None:
    """A journey as it is, if it can be used."""
    journeys = task.dataset.journeys if task.dataset is not None else ()
    return next((j for j in journeys if j.journey_id == name), None)


def _pose_change(what: str, name: str) -> Change:
    def change(task: Task) -> Changed:
        path, repair = task.path("poses.parquet"), task.repair
        origin = read_origin(read_json(task.folder / "dataset.json"))
        _write(path, POSE_CHANGES[name](pq.read_table(path), repair, origin))
        told = what.format(*repair.numbers, of=repair.of)
        return Changed(f"{task.place}/poses.parquet", told)

    return change


def _pixel_change(
    what: str, change_points: _ChangePoints, names: Sequence[str] = DETECTIONS
) -> Change:
    def change(task: Task) -> Changed:
        for name in names:
            path = task.path(f"{name}.parquet")
            table = pq.read_table(path)
            u, v = (table.column(c).combine_chunks() for c in "uv")
            count = u.value_lengths().to_numpy().astype(np.int64)
            px = np.stack([c.flatten().cast(pa.float64()).to_numpy() for c in (u, v)], axis=-1)
            px = change_points(px, count, task)
            for k, (column, given) in enumerate((("u", u), ("v", v))):
                inner = given.type.value_type
                kind = None if pa.types.is_null(inner) else inner
                table = _replaced(table, column, list_column(px[:, k], count, kind))
            _write(path, table)
        return Changed(task.place, what.format(*task.repair.numbers))

    return change


def _swapped(px: _Points, count: _Counts, task: Task) -> _Points:
    return px[:, ::-1]


def _scaled(px: _Points, count: _Counts, task: Task) -> _Points:
    by_u, by_v, add_u, add_v = task.repair.numbers
    return px * np.array([by_u, by_v]) + np.array([add_u, add_v])


def _reversed(px: _Points, count: _Counts, task: Task) -> _Points:
    start = np.cumsum(count) - count
    row = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(px)) - start[row]
    return px[start[row] + count[row] - 1 - place]


def _of_fours(count: _Counts) -> Int[np.ndarray, "fours 4"]:
    """Places of the points of rows with four."""
    start = (np.cumsum(count) - count)[count == 4]
    return start[:, None] + np.arange(4)


def _uncrossed(px: _Points, count: _Counts, task: Task) -> _Points:
    four, px = _of_fours(count), px.copy()
    # Those that do not cross themselves as they are stay: another detector may have written them.
    x, y = np.moveaxis(px[four], -1, 0)
    area = (x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y).sum(1) / 2
    crosses = area < _LEAST_FILL * np.ptp(x, axis=1) * np.ptp(y, axis=1)
    four = four[crosses]
    px[four] = px[four[:, [0, 1, 3, 2]]]
    return px


_LEAST_FILL = 0.1
"""An outline with less of its box crosses itself."""


def _boxed(px: _Points, count: _Counts, task: Task) -> _Points:
    four, px = _of_fours(count), px.copy()
    low, size = px[four[:, 0]], px[four[:, 2]]
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    px[four] = low[:, None] + size[:, None] * unit
    return px


def _distorted(px: _Points, count: _Counts, task: Task) -> _Points:
    """Pixels of the same intrinsics with the lens that the rig has."""
    journey = _known(task, task.journey)
    if journey is None:
        return px
    K = journey.rig.camera.K
    ideal = (torch.from_numpy(px) - K[:2, 2]) / torch.stack((K[0, 0], K[1, 1]))
    return distort(journey.rig.camera, ideal).numpy()


def _frames(task: Task) -> Changed:
    """Detections of a frame become those of one so many rows of poses.parquet later; those of none are left out."""
    shift, lost = round(task.repair.numbers[0]), 0
    known = pq.read_table(task.path("poses.parquet")).column("frame").to_numpy()
    for name in DETECTIONS:
        path = task.path(f"{name}.parquet")
        table = pq.read_table(path)
        row = np.searchsorted(known, table.column("frame").to_numpy()) + shift
        is_there = (row >= 0) & (row < len(known))
        lost += int((~is_there).sum())
        table = _replaced(table, "frame", pa.array(known[row.clip(0, len(known) - 1)]))
        _write(path, table.filter(pa.array(is_there)))
    what = f"detections moved {abs(shift)} frames {'later' if shift > 0 else 'earlier'}"
    left = f", {lost} that came before the first or after the last left out" if lost else ""
    return Changed(task.place, what + left)


def _rig_change(what: str, change_rig: Callable[[dict, Repair], None]) -> Change:
    def change(task: Task) -> Changed | None:
        rig = read_json(task.path("journey.json")).name("rig")
        if (rig, task.repair) in task.rigs_done:
            return None
        task.rigs_done.add((rig, task.repair))
        path = task.folder / "rigs" / rig / "rig.yaml"
        content = read_yaml(path).content
        change_rig(content, task.repair)
        with atomic_file(path) as beside:
            beside.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        return Changed(f"rigs/{rig}/rig.yaml", what.format(*task.repair.numbers))

    return change


def _turn_normal(rig: dict, repair: Repair) -> None:
    rig["road"]["normal"] = [-float(x) for x in rig["road"]["normal"]]


def _height(rig: dict, repair: Repair) -> None:
    rig["road"]["height_m"] = float(rig["road"]["height_m"]) * repair.numbers[0]


def _coefficients(rig: dict, repair: Repair) -> None:
    given = [*map(float, rig["camera"]["distortion"])]
    given += [0.0] * (5 - len(given))
    order = [round(x) for x in repair.numbers]
    rig["camera"]["distortion"] = [*(given[k] for k in order), *given[5:]]


def _leave_out_journey(task: Task) -> Changed:
    shutil.rmtree(task.folder / "journeys" / task.journey)
    return Changed(task.place, "left out")


def _cut_overlap(task: Task) -> Changed | None:
    own, other = _known(task, task.journey), _known(task, task.repair.of)
    if own is None or other is None:
        return None
    frames = own.frame_number[torch.from_numpy(common_frames(own, other))].numpy()
    for name in ("poses", *DETECTIONS):
        path = task.path(f"{name}.parquet")
        table = pq.read_table(path)
        kept = ~np.isin(table.column("frame").to_numpy(), frames)
        _write(path, table.filter(pa.array(kept)))
    what = f"the {len(frames)} frames that are in {task.repair.of!r} too left out"
    return Changed(task.place, what)


def _column_type(task: Task) -> Changed | None:
    """A column as FORMAT.md has it, where nothing is lost by that."""
    path, name = task.folder / task.file, task.repair.of
    table = pq.read_table(path)
    column = table.column(name)
    is_list = pa.types.is_list(column.type) or pa.types.is_large_list(column.type)
    wanted = pa.int64() if name in _WHOLE else pa.float64()
    wanted = pa.list_(pa.float64()) if is_list else wanted
    try:
        if pa.types.is_floating(column.type) and pa.types.is_integer(wanted):
            values = column.to_numpy()
            # Many writers have no whole numbers beside an unknown one, and make it NaN: here a null.
            unknown = np.isnan(values) & (name in _NULLABLE)
            if not (unknown | (np.isfinite(values) & (values == np.rint(values)))).all():
                return None
            column = pa.array(np.where(unknown, 0, values).astype(np.int64), mask=unknown)
        else:
            column = column.cast(wanted)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return None
    _write(path, _replaced(table, name, column))
    return Changed(task.file, f"column {name!r} written as {_TYPE_NAMES[wanted]}")


_WHOLE = ("frame", "t_ns", "track")
"""Columns of whole numbers."""
_NULLABLE = ("track",)
"""Those of them that need not be known."""
_TYPE_NAMES = {pa.int64(): "int64", pa.float64(): "float64", pa.list_(pa.float64()): "list<double>"}

_OF_POSES = {
    "sort-frames": "rows sorted by frame",
    "time-unit": "t_ns times {:g}",
    "length-unit": "x, y, z times {:g}",
    "unit-quaternions": "quaternions divided by their lengths",
    "quaternion-order": "quaternions read as w x y z",
    "inverse-poses": "poses inverted",
    "axes": "axes turned",
    "degrees": "degrees turned into metres east, north, up",
    "utm": "UTM coordinates of zone {:.0f}, and rotations with them, turned into metres east, north, up",
    "heights": "{:g} m taken off z",
    "no-sigmas": "columns {of} left out",
    "between-fixes": "x, y, z of frames that had those of the last fix put between the fixes",
}

CHANGES: dict[str, Change] = {
    **{name: _pose_change(what, name) for name, what in _OF_POSES.items()},
    "swap-pixels": _pixel_change("u and v swapped", _swapped),
    "scale-pixels": _pixel_change("u times {:.4g}, v times {:.4g}", _scaled),
    "distort": _pixel_change("pixels distorted by the rig's lens", _distorted),
    "reverse-corners": _pixel_change("corners turned round", _reversed, ("signs",)),
    "uncross-corners": _pixel_change(
        "the last two of four corners swapped", _uncrossed, ("signs",)
    ),
    "boxes": _pixel_change("boxes turned into corners", _boxed, ("signs",)),
    "frames": _frames,
    "turn-normal": _rig_change("road.normal turned round", _turn_normal),
    "height-unit": _rig_change("road.height_m times {:g}", _height),
    "coefficients": _rig_change("distortion put in OpenCV's order", _coefficients),
    "leave-out-journey": _leave_out_journey,
    "cut-overlap": _cut_overlap,
    "column-type": _column_type,
}
"""By the name of the repair."""
