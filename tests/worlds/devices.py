"""What is mapped on two devices, and what differs then."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import Tensor
from worlds.drives import with_frames

from crowdmap_torch import cli
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.tables import Dataset, Journey, Rows

FRAMES = 14
"""Of a drive that is mapped frame by frame."""
STEPS = 2
CONFIG = f"adjust:\n  lm:\n    max_iterations: {STEPS}\n"


def short() -> MapperConfig:
    """The default configuration, with few steps of adjustment."""
    config = MapperConfig()
    lm = replace(config.adjust.lm, max_iterations=STEPS)
    return replace(config, adjust=replace(config.adjust, lm=lm))


def differences(a: Rows, b: Rows) -> Iterator[str]:
    """Columns of two tables of which not every bit is the same."""
    for f in fields(a):
        one, other = getattr(a, f.name), getattr(b, f.name)
        if isinstance(one, Tensor) and not torch.equal(one.cpu(), other.cpu()):
            yield f.name


def assert_near(one: Rows, other: Rows, within: float = 1e-6) -> None:
    """The same tables, by default to a micrometre, a microradian, a millionth of their squares."""
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if isinstance(a, Tensor):
            close = torch.testing.assert_close
            close(a.cpu(), b.cpu(), rtol=within, atol=within, equal_nan=True, msg=f.name)
        elif isinstance(a, Rows):
            assert_near(a, b, within)


def first_frames(dataset: Dataset) -> Journey:
    return with_frames(dataset.journeys[0], torch.arange(FRAMES))


def optimized(folder: Path, out: Path, device: str) -> tuple[Path, str]:
    """A run of the main job on this device, in one process, and what it said."""
    config, said = folder.parent / "short.yaml", io.StringIO()
    config.write_text(CONFIG)
    options = ["--config", str(config), "--device", device, "--workers", "1", "--log-every", "2"]
    with contextlib.redirect_stdout(said):
        assert cli.main(["optimize", str(folder), "--out", str(out), *options]) == 0
    return out, said.getvalue()
