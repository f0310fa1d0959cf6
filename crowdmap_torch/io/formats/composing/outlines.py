"""Sign outlines of detectors that draw boxes or points: by names of classes to shapes, corners and rows."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import SignRows
from crowdmap_torch.io.formats.composing.sign_names import SignName

HALF_PIXEL = 0.5
"""From the corner of a pixel, where boxes are often counted from, to its centre, FORMAT.md's (0, 0)."""
BORDER_PX = 1.0
"""A box that comes closer to the image's border is taken for a sign that is cut off there."""
_COUNT = polygon.CORNER_COUNT.tolist()


def in_box(shape: int, box_px: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "8 2"]:
    """Corners of an upright, facing sign that fills a box u v width height."""
    low, size = torch.from_numpy(np.asarray(box_px, dtype=np.float64)).split(2)
    return polygon.in_box(low, low + size, torch.tensor(shape)).numpy()


def clockwise(corners_px: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, "8 2"]:
    """The same corners clockwise in the image, padded."""
    u, v = corners_px.T
    area = float((u * np.roll(v, -1) - np.roll(u, -1) * v).sum())
    turned = corners_px[::-1] if area < 0 else corners_px
    return np.concatenate((turned, np.repeat(turned[-1:], polygon.MAX_CORNERS - len(turned), 0)))


@dataclass
class SignCollector:
    """Gathers detections one by one, and counts what is left out."""

    source: Path
    names: dict[str, SignName]
    skip_unknown: bool
    images: dict[str, int] = field(default_factory=dict)
    _image: list[int] = field(default_factory=list)
    _shape: list[int] = field(default_factory=list)
    _corners: list[np.ndarray] = field(default_factory=list)
    _code: list[str | None] = field(default_factory=list)
    _score: list[float] = field(default_factory=list)
    _track: list[int] = field(default_factory=list)
    _sizes: set[tuple[float, float]] = field(default_factory=set)
    _left_out: Counter[str] = field(default_factory=Counter)
    _unknown: Counter[str] = field(default_factory=Counter)

    def image(self, name: str) -> int:
        """The number of an image, which from now on is one of those listed."""
        return self.images.setdefault(name, len(self.images))

    def shape_of(self, name: str) -> SignName | None:
        """What a class looks like; None, counted, for classes that are left out."""
        found = self.names.get(name)
        if found is None:
            self._unknown[name] += 1
            return None
        if found.shape is None:
            self.leave_out(f"of class {name!r}, whose plate is none of the mapped shapes")
            return None
        return found

    def leave_out(self, reason: str) -> None:
        """Counts a detection that makes no row."""
        self._left_out[reason] += 1

    def add(
        self,
        image: int,
        name: SignName,
        corners_px: Float[np.ndarray, "8 2"],
        *,
        score: float = float("nan"),
        track: int = -1,
    ) -> None:
        """Takes a detection in."""
        assert name.shape is not None
        self._image.append(image)
        self._shape.append(name.shape)
        self._corners.append(corners_px)
        self._code.append(name.code)
        self._score.append(score)
        self._track.append(track)
        if name.size_m is not None:
            self._sizes.add(name.size_m)

    def rows(self, size_px: tuple[int, int] | None) -> tuple[SignRows, tuple[str, ...]]:
        """What was gathered, and what was left out in words; InputError for classes that nobody knows."""
        if self._unknown and not self.skip_unknown:
            classes = ", ".join(f"{name!r} ({n})" for name, n in self._unknown.most_common(10))
            more = "" if len(self._unknown) <= 10 else f" and {len(self._unknown) - 10} more"
            raise InputError(
                f"{self.source}: what do signs of class {classes}{more} look like? Give a table of "
                "name,shape,code by --sign-names FILE, or leave them out by --skip-unknown-signs"
            )
        if self._unknown:
            known = sum(self._unknown.values())
            self._left_out[f"of {len(self._unknown)} classes that no table has"] = known
        corners = np.array(self._corners, dtype=np.float64).reshape(-1, polygon.MAX_CORNERS, 2)
        rows = SignRows(
            source=self.source,
            images=tuple(self.images),
            image=np.array(self._image, dtype=np.int64),
            shape=np.array(self._shape, dtype=np.int64),
            corners_px=corners,
            code=tuple(self._code),
            score=np.array(self._score, dtype=np.float64),
            track=np.array(self._track, dtype=np.int64),
            size_px=size_px,
            sizes_m=tuple(sorted(self._sizes)),
        )
        return rows, tuple(f"{n} signs left out: {why}" for why, n in self._left_out.items())


def corner_count(shape: int) -> int:
    """How many corners a shape has."""
    return _COUNT[shape]
