"""The usual mistakes of those who write their own data sets, each made on a good one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

QUATERNION = ("qx", "qy", "qz", "qw")
POSITION = ("x", "y", "z")


def spoiled(good: Path, bad: Path, mistake: str) -> Path:
    """A copy of a data set with one of `MISTAKES` in all its journeys or rigs."""
    shutil.copytree(good, bad)
    MISTAKES[mistake](bad)
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
    x, y, z, w = (np.array(columns[name]) for name in QUATERNION)
    R = np.stack(
        (
            np.stack((1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)), -1),
            np.stack((2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)), -1),
            np.stack((2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)), -1),
        ),
        -2,
    )
    return R, np.stack([np.array(columns[name]) for name in POSITION], -1)


def _with(columns: dict, R: np.ndarray, p: np.ndarray) -> dict:
    from scipy.spatial.transform import Rotation

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
    from crowdmap_torch.io.datasets import load_dataset

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
    lat = origin["lat_deg"] + p[:, 1] / 111_200
    lon = origin["lon_deg"] + p[:, 0] / 111_200 / np.cos(np.radians(origin["lat_deg"]))
    return np.stack((lat, lon, p[:, 2] + origin["height_m"]), -1)


def _utm(folder: Path) -> None:
    """The simulator's origin, moved to 5 degrees north, is there in zone 11; further north it is over 1,000 km."""
    head = json.loads((folder / "dataset.json").read_text())
    head["origin"] |= {"lat_deg": 5.0, "lon_deg": -117.2}
    (folder / "dataset.json").write_text(json.dumps(head))
    _moved(lambda p, origin: p + np.array([477_830.0, 552_680.0, 0.0]))(folder)


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
    import torch

    from crowdmap_torch.geometry.camera import distort, unproject
    from crowdmap_torch.io.rigs import read_rig

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


def _road(key: str, value: Callable[[object], object]):
    def change(rig: dict) -> None:
        rig["road"][key] = value(rig["road"][key])

    return lambda folder: _rigs(folder, change)


def _frames_off(folder: Path) -> None:
    frames = {p.parent.name: None for p in folder.glob("journeys/*/poses.parquet")}
    for name in frames:
        known = pq.read_table(folder / "journeys" / name / "poses.parquet")["frame"].to_pylist()
        later = dict(zip(known, known[2:] + known[-1:] * 2, strict=True))
        for kind in ("signs", "lanes"):
            path = folder / "journeys" / name / f"{kind}.parquet"
            table = pq.read_table(path)
            c = table.to_pydict()
            c["frame"] = [later[f] for f in c["frame"]]
            arrays = {k: pa.array(x, table.schema.field(k).type) for k, x in c.items()}
            pq.write_table(pa.table(arrays), path)


def _no_sigmas(c: dict) -> dict:
    zero = [0.0] * len(c["frame"])
    return c | {name: zero for name in ("sigma_e", "sigma_n", "sigma_u", "sigma_rot")}


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


MISTAKES: dict[str, Callable[[Path], None]] = {
    "quaternion-order": _quaternion_wxyz,
    "body-frame": _poses(lambda R, p: (R @ _CAMERA_IN_BODY.T, p)),
    "camera-from-world": _poses(
        lambda R, p: (R.swapaxes(-1, -2), -(R.swapaxes(-1, -2) @ p[..., None])[..., 0])
    ),
    "north-east-down": _poses(lambda R, p: (_NED @ R, p @ _NED.T)),
    "degrees": _moved(_degrees),
    "utm": _utm,
    "absolute-heights": _moved(lambda p, o: p + np.array([0.0, 0.0, o["height_m"]])),
    "swapped-pixels": _pixels(lambda u, v, camera: (v, u)),
    "unit-pixels": _pixels(lambda u, v, c: (u / c["width"], v / c["height"])),
    "image-size": _pixels(lambda u, v, camera: (u / 2, v / 2)),
    "anticlockwise": _pixels(lambda u, v, camera: (u[::-1], v[::-1]), lanes=False),
    "boxes": _coco,
    "undistorted": lambda folder: _through(folder, []),
    "no-lens": lambda folder: _with_lens(folder, []),
    "coefficient-order": lambda folder: _rigs(folder, _coefficients),
    "frame-offset": _frames_off,
    "lever-arm": _poses(lambda R, p: (R, p + R @ _ANTENNA)),
    "road-normal": _road("normal", lambda n: [-float(x) for x in n]),  # type: ignore[union-attr]
    "camera-height": _road("height_m", lambda h: 100 * float(h)),  # type: ignore[arg-type]
    "sigmas": lambda folder: _each(folder, "poses", _no_sigmas),
    "overlap": _overlap,
}
"""Mistakes by the kind of finding that names each."""
