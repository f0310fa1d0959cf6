"""A map in few bytes, and its reader: places to a tenth of a millimetre, everything else as a map has it.

A file is `CMAP1` and a line feed, then one zlib stream: the length of a JSON text (uint32), the text, and the columns that
it lists, little-endian. Places are whole numbers of tenths of a millimetre, differences along a marker taken twice; bytes
of equal weight lie together, as they are alike.
"""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import torch

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.tables import ControlPoints, HdMap, Lanes, Origin, Signs

MAGIC = b"CMAP1\n"
STEP_M = 1e-4
"""Of places, sizes and sigmas [m]."""
MAX_BYTES = 1 << 30
"""A stream that is longer is none that this module wrote."""
_SUPPORT = ("n_journeys", "n_observations", "first_seen_ns", "last_seen_ns")
_UPPER = np.triu_indices(3)


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes a compact file; returns what is rounded in it."""
    columns = _columns(hd_map)
    told = head(hd_map) | {
        "sign_id": hd_map.sign_id,
        "lane_id": hd_map.lane_id,
        "type_names": hd_map.type_names,
        "columns": [[name, str(values.dtype), *values.shape] for name, values in columns.items()],
    }
    text = json_text(told).encode()
    body = b"".join(_shuffled(values) for values in columns.values())
    stream = zlib.compress(struct.pack("<I", len(text)) + text + body, 9)
    path.write_bytes(MAGIC + stream)
    return ("digits of places below 0.1 mm, and of rotations and covariances beyond the seventh",)


def read_compact(path: Path | str) -> HdMap:
    """The map in a compact file; InputError for a file that is none, or damaged."""
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    if not content.startswith(MAGIC):
        raise InputError(
            f"{path}: is no compact map; expected it to begin with {MAGIC.decode().strip()}"
        )
    stream = zlib.decompressobj()
    try:
        body = stream.decompress(content[len(MAGIC) :], MAX_BYTES)
        if not stream.eof:
            raise ValueError("it ends too early, or holds more than 1 GiB")
        (length,) = struct.unpack_from("<I", body)
        told = json.loads(body[4 : 4 + length])
        return _map(told, _unpacked(told["columns"], body[4 + length :]))
    except (
        zlib.error,
        struct.error,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        RuntimeError,
    ) as error:
        raise InputError(f"{path}: is damaged ({one_line(error)}); export the map again") from error


def _columns(hd_map: HdMap) -> dict[str, np.ndarray]:
    signs = hd_map.signs.to("cpu")
    lanes = hd_map.lanes
    lanes = lanes.select(torch.arange(len(lanes), device=lanes.type.device)).to("cpu")
    T = signs.T_world_sign.detach()
    point = _steps(lanes.control.point_world.detach().numpy())
    starts = lanes.control_start.numpy()
    for _ in range(2):
        # Markers run smoothly: how much their steps change is small.
        before = np.concatenate((np.zeros_like(point[:1]), point[:-1]))[: len(point)]
        before[starts] = 0
        point = point - before
    return {
        "sign_shape": signs.shape.numpy().astype("<i1"),
        "sign_type": signs.type.numpy().astype("<i4"),
        "sign_center": _steps(T[:, :3, 3].numpy()),
        "sign_quaternion": se3.to_quaternion(T[:, :3, :3]).numpy().astype("<f4"),
        "sign_size": _steps(signs.size.detach().numpy()),
        "sign_covariance": signs.covariance.detach().numpy()[:, *_UPPER].astype("<f4"),
        **{f"sign_{name}": _support(signs, name) for name in (*_SUPPORT, "confidence")},
        "lane_type": lanes.type.numpy().astype("<i1"),
        "lane_count": lanes.control_count.numpy().astype("<i4"),
        **{f"lane_{name}": _support(lanes, name) for name in (*_SUPPORT, "confidence")},
        "control_point": point,
        "control_sigma": lanes.control.sigma.detach().numpy().astype("<f4"),
    }


def _support(table: Signs | Lanes, name: str) -> np.ndarray:
    return getattr(table, name).numpy().astype("<f4" if name == "confidence" else "<i8")


def _steps(metres: np.ndarray) -> np.ndarray:
    return np.round(metres / STEP_M).astype("<i8")


def _shuffled(values: np.ndarray) -> bytes:
    raw = np.ascontiguousarray(values.T).view(np.uint8).reshape(-1, values.itemsize)
    return raw.T.tobytes()


def _unpacked(listed: list, body: bytes) -> dict[str, np.ndarray]:
    found, at = {}, 0
    for name, kind, *shape in listed:
        dtype = np.dtype(kind)
        size = int(np.prod(shape)) * dtype.itemsize
        raw = np.frombuffer(body, np.uint8, size, at).reshape(dtype.itemsize, -1)
        values = np.ascontiguousarray(raw.T).view(dtype).reshape(shape[::-1]).T
        found[name] = values.copy()
        at += size
    if at != len(body):
        raise ValueError(f"{len(body) - at} bytes too many")
    return found


def _map(told: dict, columns: dict[str, np.ndarray]) -> HdMap:
    tensor = {name: torch.from_numpy(values) for name, values in columns.items()}
    n, m = len(told["sign_id"]), len(told["lane_id"])
    count = tensor["lane_count"].long()
    start = count.cumsum(0) - count
    point = columns["control_point"]
    if int(count.sum()) != len(point) or bool((count < 2).any()):
        raise ValueError("control points do not belong to the markers")
    for _ in range(2):
        total = np.cumsum(point, axis=0)
        base = (total - point)[start.numpy()]
        point = total - np.repeat(base, count.numpy(), axis=0)
    covariance = torch.zeros(n, 3, 3, dtype=torch.float64)
    covariance[:, *_UPPER] = tensor["sign_covariance"].double()
    covariance = covariance + covariance.triu(1).mT
    quaternion = torch.nn.functional.normalize(tensor["sign_quaternion"].double(), dim=-1)
    shape = tensor["sign_shape"].long()
    if n and not 0 <= int(shape.min()) <= int(shape.max()) < len(polygon.SHAPES):
        raise ValueError("a sign's shape is unknown")
    signs = Signs(
        shape=shape,
        type=tensor["sign_type"].long(),
        T_world_sign=se3.make(
            se3.from_quaternion(quaternion), tensor["sign_center"].double() * STEP_M
        ),
        size=tensor["sign_size"].double() * STEP_M,
        covariance=covariance,
        **_read_support(tensor, "sign", n),
    )
    lanes = Lanes(
        type=tensor["lane_type"].long(),
        control_start=start,
        control_count=count,
        **_read_support(tensor, "lane", m),
        control=ControlPoints(
            point_world=torch.from_numpy(point).double() * STEP_M,
            sigma=tensor["control_sigma"].double(),
        ),
    )
    return HdMap(
        origin=Origin(**told["origin"]),
        signs=signs,
        lanes=lanes,
        sign_id=tuple(told["sign_id"]),
        lane_id=tuple(told["lane_id"]),
        type_names=tuple(told["type_names"]),
        shared_covariance=torch.tensor(told["shared_covariance"], dtype=torch.float64).reshape(
            3, 3
        ),
        provenance=told["provenance"],
    )


def _read_support(tensor: dict[str, torch.Tensor], kind: str, rows: int) -> dict[str, torch.Tensor]:
    none = torch.full((rows,), -1)
    return {
        **dict.fromkeys(("journey", "tracklet", "frame"), none),
        **{name: tensor[f"{kind}_{name}"].long() for name in _SUPPORT},
        "confidence": tensor[f"{kind}_confidence"].double(),
    }
