"""The device that a benchmark is asked for: whether it is there, and when it is done."""

from __future__ import annotations

import torch

from crowdmap_torch.io.errors import InputError


def there(name: str) -> torch.device | None:
    """The device of a name; None: it is not there."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise InputError(f"--device {name}: expected cpu or cuda") from None
    return None if device.type == "cuda" and not torch.cuda.is_available() else device


def finish(device: torch.device) -> None:
    """Waits for what was begun there."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
