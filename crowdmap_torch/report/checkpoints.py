"""The unknowns of a bundle adjustment on disk, so that it can go on where it was interrupted."""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from crowdmap_torch.io.atomic import atomic_file

_FORMAT = 1


@dataclass(frozen=True)
class Checkpoint:
    """What was saved beside the module's own state."""

    iteration: int
    """Steps taken when it was saved."""
    state: dict[str, Any]
    """The solver's own numbers: tensors, numbers, strings."""


def save_checkpoint(
    path: Path,
    module: nn.Module,
    *,
    config_hash: str,
    iteration: int,
    state: dict[str, Any] | None = None,
) -> None:
    """Write a module's state: whoever reads `path` sees the old checkpoint or the new one."""
    content = {
        "format": _FORMAT,
        "config_hash": config_hash,
        "iteration": iteration,
        "module": module.state_dict(),
        "state": state or {},
    }
    # Torch itself does not say why a disk takes no more.
    saved = io.BytesIO()
    torch.save(content, saved)
    with atomic_file(path) as beside:
        beside.write_bytes(saved.getbuffer())


def load_checkpoint(path: Path, module: nn.Module, *, config_hash: str) -> Checkpoint:
    """Put a saved state into a module; ValueError if it does not fit."""
    place = next((p.device for p in module.parameters()), torch.device("cpu"))
    try:
        content = torch.load(path, map_location=place, weights_only=True)
    except (pickle.UnpicklingError, EOFError, RuntimeError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"{path}: not a checkpoint ({first}). Delete it to start from the beginning."
        ) from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(
            f"{path}: expected a checkpoint of format {_FORMAT}. Delete it to start anew."
        )
    if content["config_hash"] != config_hash:
        raise ValueError(
            f"{path}: saved with configuration {content['config_hash']}, not {config_hash}. "
            "Resume with the configuration of the run, or start anew with --overwrite."
        )
    own = module.state_dict()
    saved = content["module"]
    wrong = [k for k in own if k not in saved or saved[k].shape != own[k].shape]
    wrong += [k for k in saved if k not in own]
    if wrong:
        raise ValueError(
            f"{path}: {wrong[0]!r} does not fit the problem; expected the unknowns of the same "
            "journeys and landmarks. Did the dataset change? Start anew with --overwrite."
        )
    module.load_state_dict(saved)
    return Checkpoint(iteration=content["iteration"], state=content["state"])
