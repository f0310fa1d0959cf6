"""Numbers in few bytes: whole steps of a unit, differences, equal bytes together, deflated; read by `payload.js`.

A payload is one zlib stream: the length of a JSON text (uint32, little-endian), the text, and the columns that it lists
under `columns`, as name, bytes a number, rows, width, step and the axis along which differences were taken (`rows`,
`pairs`: each pair of numbers of a row against the pair before, or null). Numbers are signed; bytes of equal weight lie
together, column by column. A step of 0 marks 32-bit floats as they are.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import Tensor

_WIDEST = {1: 2**7, 2: 2**15, 4: 2**31}
_LEVEL = 7
"""Of zlib: the last two levels save 1.5 % of the bytes and take ten times as long."""


@dataclass(frozen=True)
class Column:
    """Numbers and how they are kept."""

    values: np.ndarray
    """Of any shape; rows first."""
    step: float = 1.0
    """What is kept is off by half of this at most; 0 keeps 32-bit floats."""
    difference: str | None = None
    """`rows` or `pairs` where neighbours are alike."""


def column(values: Tensor | np.ndarray, step: float = 1.0, difference: str | None = None) -> Column:
    """A column of a tensor, wherever it is."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return Column(values, step, difference)


def packed(head: Mapping[str, object], columns: Mapping[str, Column]) -> bytes:
    """A payload. ValueError for numbers that are not finite, or beyond 2^31 steps."""
    listed, body = [], []
    for name, one in columns.items():
        rows, width = len(one.values), int(np.prod(one.values.shape[1:], dtype=int))
        flat = np.asarray(one.values).reshape(rows, width)
        whole, size = _whole(name, flat, one)
        raw = np.ascontiguousarray(whole.T).view(np.uint8).reshape(-1, size)
        body.append(raw.T.tobytes())
        listed.append([name, size, rows, width, one.step, one.difference])
    text = json.dumps({**head, "columns": listed}, ensure_ascii=False, allow_nan=False).encode()
    return zlib.compress(struct.pack("<I", len(text)) + text + b"".join(body), _LEVEL)


def encoded(payload: bytes) -> str:
    """A payload as it stands in a page: letters, digits, `+`, `/` and `=`, nothing that ends a script."""
    return base64.b64encode(payload).decode("ascii")


def unpacked(payload: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Head and columns, rows by width, of what `packed` made."""
    body = zlib.decompress(payload)
    (length,) = struct.unpack_from("<I", body)
    head = json.loads(body[4 : 4 + length])
    at, found = 4 + length, {}
    for name, size, rows, width, step, difference in head.pop("columns"):
        raw = np.frombuffer(body, np.uint8, rows * width * size, at).reshape(size, -1)
        at += rows * width * size
        kind = "<f4" if step == 0 else f"<i{size}"
        whole = np.ascontiguousarray(raw.T).view(kind).reshape(width, rows).T
        if step == 0:
            found[name] = whole.astype(np.float64)
            continue
        whole = whole.astype(np.int64)
        if difference == "rows":
            whole = np.cumsum(whole, axis=0)
        elif difference == "pairs":
            whole = np.cumsum(whole.reshape(rows, width // 2, 2), axis=1).reshape(rows, width)
        found[name] = whole * step
    return head, found


def _whole(name: str, flat: np.ndarray, one: Column) -> tuple[np.ndarray, int]:
    """What is kept of a column, and how many bytes a number."""
    if not np.isfinite(flat).all():
        raise ValueError(f"{name}: a number is not finite; the viewer shows finite ones only")
    if one.step == 0:
        return flat.astype("<f4"), 4
    scaled = np.round(flat / one.step)
    if np.abs(scaled).max(initial=0) >= _WIDEST[4]:
        raise ValueError(f"{name}: a number is beyond {_WIDEST[4]} steps of {one.step:g}")
    whole = scaled.astype(np.int64)
    if one.difference == "rows":
        whole = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1]))
    elif one.difference == "pairs":
        pairs = whole.reshape(len(whole), whole.shape[1] // 2, 2)
        whole = np.diff(pairs, axis=1, prepend=np.zeros_like(pairs[:, :1])).reshape(whole.shape)
    most = int(np.abs(whole).max(initial=0))
    size = next((size for size, limit in _WIDEST.items() if most < limit), None)
    if size is None:
        raise ValueError(f"{name}: neighbours are further apart than {_WIDEST[4]} steps")
    return whole.astype(f"<i{size}"), size
