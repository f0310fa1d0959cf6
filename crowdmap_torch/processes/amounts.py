"""How much is computed at once: on a processor what its cache holds, on a GPU what keeps all of it busy."""

from __future__ import annotations

import torch

_ON_A_GPU = 64
"""There a call costs as much as work on a hundred thousand numbers, and cache matters little."""


def at_once(count: int, device: torch.device, *, each: int = 1) -> int:
    """As much as `count` on a CPU, in units of `each`, one of them at least."""
    much = count if device.type == "cpu" else count * _ON_A_GPU
    return max(much // max(each, 1), 1)
