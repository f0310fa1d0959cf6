"""Finished stages of a computation, one file each, kept so that it can go on where it was interrupted.

A file is a line that says what it is, a line with the SHA-256 of the rest, and the rest: a tree (`io.trees`) as `torch.save`
writes it, which is read back without running any code. It is complete or not there.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import stat
from pathlib import Path
from typing import Any

import torch

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.errors import one_line
from crowdmap_torch.io.trees import from_tree, to_tree

_HEAD = b"crowdmap stage 1\n"
_DIGITS = 64


def write_stage(path: Path, value: Any, *, key: str) -> None:
    """Keeps a value made of frozen dataclasses, tensors and numbers; `key` says what it was made from."""
    content = io.BytesIO()
    torch.save({"key": key, "tree": to_tree(value)}, content)
    with atomic_file(path) as beside, beside.open("wb") as file:
        file.write(_HEAD + hashlib.sha256(content.getbuffer()).hexdigest().encode() + b"\n")
        file.write(content.getbuffer())


def read_stage(path: Path, kind: Any, *, key: str, device: torch.device | str = "cpu") -> Any:
    """The value that was kept, by its class; None if there is none.

    ValueError if the file is damaged, holds something else, or was made from something else than `key` says.
    """
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            raise ValueError(f"{path}: expected a file of its own, no link or device")
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    start = len(_HEAD) + _DIGITS + 1
    body = memoryview(content)[start:]
    if content[:start] != _HEAD + hashlib.sha256(body).hexdigest().encode() + b"\n":
        raise ValueError(f"{path}: is cut off, damaged or no stage of a run")
    try:
        kept = torch.load(io.BytesIO(body), map_location=device, weights_only=True)
    except (pickle.UnpicklingError, EOFError, RuntimeError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: cannot be read ({one_line(error)[:100]})") from None
    if not isinstance(kept, dict) or set(kept) != {"key", "tree"}:
        raise ValueError(f"{path}: holds no stage of a run")
    if kept["key"] != key:
        raise ValueError(f"{path}: was made from something else")
    try:
        return from_tree(kind, kept["tree"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
