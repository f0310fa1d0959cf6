"""The usual mistakes of those who write their own data sets, each made on a good one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml
from scipy.spatial.transform import Rotation

from crowdmap_torch.geometry.camera import MODELS, distort, unproject
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.formats.composing.utm import convergence, grid_from_geodetic
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.plausibility.lever import HIDDEN_LEVER
from crowdmap_torch.tables import Dataset, Origin


@dataclass(frozen=True)
class Mistake:
    """A mistake, and what is to be said of it."""

    kind: str
    """Of the finding that names it."""
    make: Callable[[Path], None]
    cause: str
    """Words of its cause."""
    is_cured: bool = True
    """Whether `crowdmap check --fix` puts it right."""
    leaves: str = ""
    """Kind of the finding that is left once it was put right: of what is lost for good."""
    may_hide: bool = False
    """True: not all drives show it (docs/OWN_DATA.md), and what does not show need not be named."""
    hidden_as: str = ""
    """Kind of the note that says so where it does not show."""
    of_models: tuple[str, ...] = MODELS
    """Camera models with which it can be made."""
    of_lens: bool = False
    """True: it cannot be made where rigs have no distortion."""

    def can_be_made(self, good: Dataset) -> bool:
        """Whether a data set has what it takes to make the mistake in all of its rigs."""
        cameras = [journey.rig.camera for journey in good.journeys]
        return all(
            c.model in self.of_models and (bool((c.distortion != 0).any()) or not self.of_lens)
            for c in cameras
        )


QUATERNION = ("qx", "qy", "qz", "qw")
POSITION = ("x", "y", "z")


def spoiled(good: Path, bad: Path, mistake: str) -> Path:
    """A copy of a data set with one of `MISTAKES` in all its journeys or rigs."""
    shutil.copytree(good, bad)
    MISTAKES[mistake].make(bad)
    return bad


def _each(folder: Path, name: str, change: Callable[[dict], dict]) -> None:
    """Changes the columns (lists of Python values) of one file of every journey."""
    for path in sorted(folder.glob(f"journeys/*/{name}.parquet")):
        table = pq.read_table(path)
        changed = change(table.to_pydict())
        arrays = {
            key: pa.array(
                value, table.schema.field(key).type if key in table.column_names else None
            )
            for key, value in changed.items()
        }
        pq.write_table(pa.table(arrays), path)


def _rigs(folder: Path, change: Callable[[dict], None]) -> None:
    for path in folder.glob("rigs/*/rig.yaml"):
        content = yaml.safe_load(path.read_text())
        change(content)
        path.write_text(yaml.safe_dump(content))


def _matrices(columns: dict) -> tuple[np.ndarray, np.ndarray]:
    q = np.stack([np.array(columns[name]) for name in QUATERNION], -1)
    R = Rotation.from_quat(q).as_matrix()
    return R, np.stack([np.array(columns[name]) for name in POSITION], -1)


def _with(columns: dict, R: np.ndarray, p: np.ndarray) -> dict:
    q = Rotation.from_matrix(R).as_quat()
    return (
        columns
        | {name: q[:, k].tolist() for k, name in enumerate(QUATERNION)}
        | {name: p[:, k].tolist() for k, name in enumerate(POSITION)}
    )


def _quaternion_wxyz(folder: Path) -> None:
    def change(c: dict) -> dict:
        return c | dict(zip(QUATERNION, (c["qw"], c["qx"], c["qy"], c["qz"]), strict=True))

    _each(folder, "poses", change)


def _no_mount(folder: Path) -> None:
    """The poses become the camera's own, so that what is wrong with them is nobody else's."""
    T = {j.journey_id: j.T_world_camera.numpy() for j in load_dataset(folder).journeys}
    for path in sorted(folder.glob("journeys/*/poses.parquet")):
        table, own = pq.read_table(path), T[path.parent.name]
        columns = _with(table.to_pydict(), own[:, :3, :3], own[:, :3, 3])
        pq.write_table(pa.table(columns), path)
    _rigs(folder, lambda rig: rig.pop("mount", None))


_CAMERA_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of the camera in a body frame with x ahead, y left, z up."""
_ANTENNA = np.array([0.3, -0.5, -1.2])
"""Place of an antenna in the camera's frame: behind it, above it and aside."""
_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def _poses(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]):
    def spoil(folder: Path) -> None:
        _no_mount(folder)
        _each(folder, "poses", lambda c: _with(c, *change(*_matrices(c))))

    return spoil


def _moved(change: Callable[[np.ndarray, dict], np.ndarray]):
    def spoil(folder: Path) -> None:
        origin = json.loads((folder / "dataset.json").read_text())["origin"]

        def moved(c: dict) -> dict:
            R, p = _matrices(c)
            return _with(c, R, change(p, origin))

        _each(folder, "poses", moved)

    return spoil


def _degrees(p: np.ndarray, origin: dict) -> np.ndarray:
    return geodetic_from_local(p, Origin(**origin))


def _utm(folder: Path) -> None:
    """Positions and rotations in the grid of zone 11, of an origin 5 degrees north: further north it is over 1,000 km."""
    for path in (folder / "dataset.json", folder / "survey" / "map.json"):
        head = json.loads(path.read_text())
        head["origin"] |= {"lat_deg": 5.0, "lon_deg": -117.2}
        path.write_text(json.dumps(head))
    head = json.loads((folder / "dataset.json").read_text())
    origin, zone = Origin(**head["origin"]), 11
    angle = convergence(np.array([origin.lat_deg, origin.lon_deg]), zone)
    turn = Rotation.from_euler("z", angle).as_matrix()

    def in_grid(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        grid = grid_from_geodetic(geodetic_from_local(p, origin)[:, :2], zone)
        return turn @ R, np.concatenate((grid, p[:, 2:]), -1)

    _each(folder, "poses", lambda c: _with(c, *in_grid(*_matrices(c))))


def _pixels(change: Callable[[np.ndarray, np.ndarray, dict], tuple], *, lanes: bool = True):
    def spoil(folder: Path) -> None:
        camera = yaml.safe_load(next(iter(folder.glob("rigs/*/rig.yaml"))).read_text())["camera"]

        def changed(c: dict) -> dict:
            pairs = [
                change(np.array(u), np.array(v), camera)
                for u, v in zip(c["u"], c["v"], strict=True)
            ]
            return c | {"u": [u.tolist() for u, _ in pairs], "v": [v.tolist() for _, v in pairs]}

        _each(folder, "signs", changed)
        if lanes:
            _each(folder, "lanes", changed)

    return spoil


def _boxes(u: np.ndarray, v: np.ndarray, camera: dict) -> tuple[np.ndarray, np.ndarray]:
    """x, y, w, h taken for two opposite corners."""
    x, y, w, h = u.min(), v.min(), np.ptp(u), np.ptp(v)
    return np.array([x, w, w, x]), np.array([y, y, h, h])


def _coco(folder: Path) -> None:
    def rectangles(c: dict) -> dict:
        return c | {"shape": ["rectangle"] * len(c["shape"])}

    _each(folder, "signs", rectangles)
    _pixels(_boxes, lanes=False)(folder)


def _through(folder: Path, lens: list[float]) -> None:
    """Detections in pixels of the rigs' intrinsics with another distortion; the rigs stay as they are."""
    for path in sorted(folder.glob("journeys/*/journey.json")):
        camera = read_rig(folder / "rigs" / json.loads(path.read_text())["rig"]).camera
        other = replace(camera, model="brown_conrady", distortion=camera.K.new_tensor(lens))
        for name in ("signs", "lanes"):
            file = path.parent / f"{name}.parquet"
            table = pq.read_table(file)
            c = table.to_pydict()
            count = [len(u) for u in c["u"]]
            flat = np.stack((np.concatenate(c["u"]), np.concatenate(c["v"])), -1)
            ideal, _ = unproject(camera, torch.from_numpy(flat).double())
            px = np.split(distort(other, ideal).numpy(), np.cumsum(count)[:-1])
            c |= {"u": [p[:, 0].tolist() for p in px], "v": [p[:, 1].tolist() for p in px]}
            arrays = {k: pa.array(x, table.schema.field(k).type) for k, x in c.items()}
            pq.write_table(pa.table(arrays), file)


def _with_lens(folder: Path, lens: list[float]) -> None:
    """Rigs with another distortion; detections stay as they are."""
    _rigs(folder, lambda rig: rig["camera"].update(distortion=lens))


def relensed(good: Path, bad: Path, lens: list[float]) -> Path:
    """A copy of a data set as if all its cameras had another distortion."""
    shutil.copytree(good, bad)
    _through(bad, lens)
    _with_lens(bad, lens)
    return bad


def _coefficients(rig: dict) -> None:
    k1, k2, p1, p2, _ = (*rig["camera"]["distortion"], 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    rig["camera"]["distortion"] = [k1, p1, p2, k2]


def _road(key: str, value: Callable[[Any], object]):
    def change(rig: dict) -> None:
        rig["road"][key] = value(rig["road"][key])

    return lambda folder: _rigs(folder, change)


def _frames_off(folder: Path) -> None:
    """Detections are numbered two frames late; what comes after the last one is gone."""
    for journey in sorted((folder / "journeys").iterdir()):
        known = pq.read_table(journey / "poses.parquet")["frame"].to_pylist()
        later = dict(zip(known, known[2:], strict=False))
        for kind in ("signs", "lanes"):
            table = pq.read_table(journey / f"{kind}.parquet")
            table = table.filter(pa.array([f in later for f in table["frame"].to_pylist()]))
            frame = pa.array([later[f] for f in table["frame"].to_pylist()], pa.int64())
            table = table.set_column(table.column_names.index("frame"), "frame", frame)
            pq.write_table(table, journey / f"{kind}.parquet")


def _no_sigmas(c: dict) -> dict:
    zero = [0.0] * len(c["frame"])
    return c | {name: zero for name in ("sigma_e", "sigma_n", "sigma_u", "sigma_rot")}


def _last_fix(c: dict) -> dict:
    """A receiver with a third of the camera's rate, joined by the last fix before each frame."""
    row = [k - k % 3 for k in range(len(c["frame"]))]
    return c | {name: [c[name][k] for k in row] for name in POSITION + QUATERNION}


def _overlap(folder: Path) -> None:
    """The first drive becomes two, which share an eighth of its frames."""
    first = sorted((folder / "journeys").iterdir())[0]
    second = Path(shutil.copytree(first, folder / "journeys" / "second-half"))
    head = json.loads((second / "journey.json").read_text())
    (second / "journey.json").write_text(json.dumps(head | {"journey_id": second.name}))
    frames = pq.read_table(first / "poses.parquet")["frame"].to_numpy()
    n = len(frames)
    for journey, kept in ((first, frames[: 5 * n // 8]), (second, frames[n // 2 :])):
        for name in ("poses", "signs", "lanes"):
            table = pq.read_table(journey / f"{name}.parquet")
            is_kept = np.isin(table["frame"].to_numpy(), kept)
            pq.write_table(table.filter(pa.array(is_kept)), journey / f"{name}.parquet")


def _times(factor: int) -> Callable[[Path], None]:
    return lambda folder: _each(
        folder, "poses", lambda c: c | {"t_ns": [t // factor for t in c["t_ns"]]}
    )


def _seconds(folder: Path) -> None:
    for path in sorted(folder.glob("journeys/*/poses.parquet")):
        table = pq.read_table(path)
        seconds = pa.array(table["t_ns"].to_numpy() * 1e-9)
        pq.write_table(table.set_column(table.column_names.index("t_ns"), "t_ns", seconds), path)


def _shuffled(c: dict) -> dict:
    """Two halves of a drive, the second one first."""
    half = len(c["frame"]) // 2
    return {name: values[half:] + values[:half] for name, values in c.items()}


def _rounded(c: dict) -> dict:
    return c | {name: [round(x, 2) for x in c[name]] for name in QUATERNION}


def _row_by_row(u: np.ndarray, v: np.ndarray, camera: dict) -> tuple[np.ndarray, np.ndarray]:
    order = [0, 1, 3, 2] if len(u) == 4 else slice(None)
    return u[order], v[order]


def _single(folder: Path) -> None:
    """Positions as float32."""
    for path in sorted(folder.glob("journeys/*/poses.parquet")):
        table = pq.read_table(path)
        for name in POSITION:
            k = table.column_names.index(name)
            table = table.set_column(k, name, table.column(k).cast(pa.float32()))
        pq.write_table(table, path)


def _whole_pixels(folder: Path) -> None:
    for path in sorted(folder.glob("journeys/*/signs.parquet")):
        table = pq.read_table(path)
        for name in "uv":
            k = table.column_names.index(name)
            whole = [[round(x) for x in row] for row in table.column(k).to_pylist()]
            table = table.set_column(k, name, pa.array(whole, pa.list_(pa.int64())))
        pq.write_table(table, path)


def _copied(folder: Path) -> None:
    """The first drive once more, under another name."""
    first = sorted((folder / "journeys").iterdir())[0]
    second = Path(shutil.copytree(first, folder / "journeys" / "uploaded-again"))
    head = json.loads((second / "journey.json").read_text())
    (second / "journey.json").write_text(json.dumps(head | {"journey_id": second.name}))


MISTAKES: dict[str, Mistake] = {
    "w-x-y-z": Mistake("quaternion-order", _quaternion_wxyz, "w x y z"),
    "body-frame": Mistake(
        "body-frame", _poses(lambda R, p: (R @ _CAMERA_IN_BODY.T, p)), "a body frame"
    ),
    "opengl": Mistake(
        "camera-axes", _poses(lambda R, p: (R @ np.diag([1.0, -1.0, -1.0]), p)), "OpenGL"
    ),
    "inverse-poses": Mistake(
        "camera-from-world",
        _poses(lambda R, p: (R.swapaxes(-1, -2), -(R.swapaxes(-1, -2) @ p[..., None])[..., 0])),
        "T_camera_world",
    ),
    "north-east-down": Mistake(
        "north-east-down", _poses(lambda R, p: (_NED @ R, p @ _NED.T)), "north-east-down"
    ),
    "degrees": Mistake("degrees", _moved(_degrees), "in degrees"),
    "utm": Mistake("utm", _utm, "UTM"),
    "heights": Mistake(
        "absolute-heights",
        _moved(lambda p, origin: p + np.array([0.0, 0.0, origin["height_m"]])),
        "heights over the ellipsoid",
    ),
    "millimetres": Mistake("speed", _moved(lambda p, origin: p * 1e3), "millimetres"),
    "kilometres": Mistake("crawl", _moved(lambda p, origin: p * 1e-3), "kilometres"),
    "microseconds": Mistake("frame-times", _times(10**3), "microseconds"),
    "milliseconds": Mistake("frame-times", _times(10**6), "milliseconds"),
    "seconds": Mistake("frame-times", _seconds, "in seconds"),
    "unsorted": Mistake(
        "unsorted-frames", lambda folder: _each(folder, "poses", _shuffled), "not sorted"
    ),
    "rounded": Mistake(
        "quaternion-length",
        lambda folder: _each(folder, "poses", _rounded),
        "rounded",
        leaves="rounded-rotations",
    ),
    "float32": Mistake("column-type", _single, "another type"),
    "whole-pixels": Mistake("column-type", _whole_pixels, "another type"),
    "swapped-pixels": Mistake("swapped-pixels", _pixels(lambda u, v, c: (v, u)), "swapped"),
    "unit-pixels": Mistake(
        "unit-pixels", _pixels(lambda u, v, c: (u / c["width"], v / c["height"])), "shares"
    ),
    "half-size": Mistake(
        "image-size",
        _pixels(lambda u, v, c: ((u + 0.5) / 2 - 0.5, (v + 0.5) / 2 - 0.5)),
        "of an image of about",
    ),
    "anticlockwise": Mistake(
        "anticlockwise", _pixels(lambda u, v, c: (u[::-1], v[::-1]), lanes=False), "anticlockwise"
    ),
    "row-by-row": Mistake("crossed-corners", _pixels(_row_by_row, lanes=False), "row by row"),
    "boxes": Mistake("boxes", _coco, "boxes"),
    "undistorted": Mistake(
        "undistorted",
        lambda folder: _through(folder, []),
        "undistorted",
        may_hide=True,
        of_lens=True,
    ),
    "no-lens": Mistake(
        "no-lens",
        lambda folder: _with_lens(folder, []),
        "raw pixels",
        is_cured=False,
        may_hide=True,
        of_models=("brown_conrady",),
        of_lens=True,
    ),
    "coefficients": Mistake(
        "coefficient-order",
        lambda folder: _rigs(folder, _coefficients),
        "in another order",
        may_hide=True,
        of_models=("brown_conrady",),
        of_lens=True,
    ),
    "frames-late": Mistake("frame-offset", _frames_off, "frame numbers"),
    "antenna": Mistake(
        "lever-arm",
        _poses(lambda R, p: (R, p + R @ _ANTENNA)),
        "an antenna",
        is_cured=False,
        may_hide=True,
        hidden_as=HIDDEN_LEVER,
    ),
    "normal-up": Mistake(
        "road-normal", _road("normal", lambda n: [-float(x) for x in n]), "upwards"
    ),
    "centimetres-high": Mistake(
        "camera-height", _road("height_m", lambda h: 100 * float(h)), "centimetres"
    ),
    "no-sigmas": Mistake(
        "sigmas", lambda folder: _each(folder, "poses", _no_sigmas), "does not know"
    ),
    "last-fix": Mistake(
        "held-positions", lambda folder: _each(folder, "poses", _last_fix), "of the last fix"
    ),
    "overlap": Mistake("overlap", _overlap, "cut into journeys"),
    "copy": Mistake("copy", _copied, "more than once"),
}
"""By name."""
