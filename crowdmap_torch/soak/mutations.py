"""A data set destroyed at random: tables, texts, bytes, files, folders and links; the same seed destroys the same."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa

from crowdmap_torch.soak.tables import mutate_table
from crowdmap_torch.soak.texts import mutate_document, mutate_urdf


def destroy(folder: Path, rng: np.random.Generator) -> list[str]:
    """Destroys a data set in place, in one to three ways; what was done to which file."""
    count = int(rng.choice([1, 1, 1, 1, 2, 3]))
    return [_once(folder, rng) for _ in range(count)]


def _once(folder: Path, rng: np.random.Generator) -> str:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    if not files:
        return "nothing: no file is left"
    # Half of a data set's files are the survey's, which `crowdmap evaluate` reads too, and in less time.
    inside = [p for p in files if "survey" not in p.relative_to(folder).parts]
    if inside and rng.random() < 0.9:
        files = inside
    path = files[rng.integers(len(files))]
    way = rng.random()
    if way < 0.15:
        done = _bytes(path, rng)
    elif way < 0.3:
        done = _place(folder, path, rng)
    else:
        done = _content(path, rng)
    return f"{path.relative_to(folder)}: {done}"


def _content(path: Path, rng: np.random.Generator) -> str:
    try:
        if path.suffix == ".parquet":
            return mutate_table(path, rng)
        if path.suffix == ".urdf":
            return mutate_urdf(path, rng)
        return mutate_document(path, rng)
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, IndexError) as error:
        # What an earlier mutation left may be no such file any more, or hold nothing to change.
        return f"{_bytes(path, rng)} (after {type(error).__name__})"


def _bytes(path: Path, rng: np.random.Generator) -> str:
    content = bytearray(path.read_bytes())
    way = str(
        rng.choice(["flips", "flips", "end", "end", "cut", "zeros", "noise", "empty", "more"])
    )
    if way in ("flips", "end") and content:
        count = int(rng.choice([1, 1, 3, 30]))
        first = max(len(content) - 1500, 0) if way == "end" else 0
        for at in rng.integers(first, len(content), size=count):
            content[at] ^= 1 << int(rng.integers(8))
        way = f"{count} bits flipped{' at the end' if way == 'end' else ''}"
    elif way == "cut":
        content = content[: rng.integers(len(content) + 1)]
    elif way == "zeros" and content:
        at = int(rng.integers(len(content)))
        content[at : at + 100] = bytes(len(content[at : at + 100]))
    elif way == "noise":
        content = bytearray(rng.bytes(int(rng.integers(1, 5000))))
    elif way == "empty":
        content = bytearray()
    else:
        content += rng.bytes(100)
    path.write_bytes(content)
    return way


def _place(folder: Path, path: Path, rng: np.random.Generator) -> str:
    """Something else where a file or its folder was."""
    target = path if rng.random() < 0.6 else path.parent
    if target == folder or rng.random() < 0.15:
        target = path
    files = sorted(p for p in folder.rglob(f"*{path.suffix}") if p.is_file())
    ways = [
        "gone",
        "folder",
        "pipe",
        "circle",
        "nowhere",
        "device",
        "outside",
        "other",
        "name",
        "copy",
    ]
    way = str(rng.choice(ways))
    if way == "other":
        other = files[rng.integers(len(files))]
        shutil.copyfile(other, path) if other != path else None
        return f"the content of {other.relative_to(folder)}"
    if way == "name":
        new = str(rng.choice(["a b", "a\nb", "💥", "x" * 255, ".hidden", "-rf", "a'\"b", "\u202e"]))
        target.rename(target.with_name(new))
        return f"{target.name} renamed to {new[:20]!r}"
    if way == "copy":
        return _copied(folder, rng)
    shutil.rmtree(target) if target.is_dir() else target.unlink()
    if way == "folder":
        target.mkdir()
    elif way == "pipe":
        os.mkfifo(target)
    elif way != "gone":
        to = {"circle": target.name, "nowhere": "nowhere", "device": "/dev/zero", "outside": "/etc"}
        target.symlink_to(to[way])
    return f"{target.name}: {way}"


def _copied(folder: Path, rng: np.random.Generator) -> str:
    journeys = sorted(p for p in (folder / "journeys").glob("*") if p.is_dir())
    if not journeys:
        return "nothing: no journey is left"
    one = journeys[rng.integers(len(journeys))]
    new = one.with_name("again")
    shutil.copytree(one, new, symlinks=True, ignore=_pipes, dirs_exist_ok=True)
    head = new / "journey.json"
    if head.is_file() and rng.random() < 0.7:
        try:
            head.write_text(json.dumps(json.loads(head.read_text()) | {"journey_id": "again"}))
        except (ValueError, TypeError):
            return f"{one.name} copied, its journey.json is none"
    return f"{one.name} copied"


def _pipes(folder: str, names: list[str]) -> list[str]:
    return [n for n in names if (p := Path(folder, n)).exists() and not (p.is_file() or p.is_dir())]
