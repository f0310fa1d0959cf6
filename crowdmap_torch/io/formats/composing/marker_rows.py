"""Lane markers of detectors, gathered one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from crowdmap_torch.io.formats.composing.outlines import HALF_PIXEL
from crowdmap_torch.io.formats.composing.parts import LaneRows


@dataclass
class MarkerCollector:
    """Gathers lane markers, and counts what is left out."""

    source: Path
    pixel_origin: str | None
    """`corner` if the user says so; else pixels count from centres."""
    images: dict[str, int] = field(default_factory=dict)
    _image: list[int] = field(default_factory=list)
    _points: list[np.ndarray] = field(default_factory=list)
    _type: list[int] = field(default_factory=list)
    _score: list[float] = field(default_factory=list)
    _short: int = 0

    def image(self, name: str) -> int:
        """The number of an image, which from now on is one of those listed."""
        return self.images.setdefault(name, len(self.images))

    def add(
        self,
        image: int,
        points_px: Sequence[Sequence[float]],
        *,
        type_code: int = -1,
        score: float = float("nan"),
    ) -> None:
        """Takes a marker in, if it has two points at least."""
        if len(points_px) < 2:
            self._short += 1
            return
        shift = HALF_PIXEL if self.pixel_origin == "corner" else 0.0
        self._image.append(image)
        self._points.append(np.array(points_px, dtype=np.float64) - shift)
        self._type.append(type_code)
        self._score.append(score)

    def rows(self, size_px: tuple[int, int] | None = None) -> tuple[LaneRows, tuple[str, ...]]:
        """What was gathered, and what was left out in words."""
        rows = LaneRows(
            source=self.source,
            images=tuple(self.images),
            image=np.array(self._image, dtype=np.int64),
            count=np.array([len(points) for points in self._points], dtype=np.int64),
            px=np.concatenate([np.zeros((0, 2)), *self._points]),
            type=np.array(self._type, dtype=np.int64),
            score=np.array(self._score, dtype=np.float64),
            size_px=size_px,
        )
        short = f"{self._short} lane markers left out: with less than two points"
        return rows, (short,) if self._short else ()
