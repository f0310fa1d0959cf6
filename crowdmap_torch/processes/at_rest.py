"""Tensors that rest in a file until somebody reads them: memory that the system can take back when others need it.

A drive is read, mapped by itself, and looked at again when the map is made. In between its tables are hundreds of megabytes
for each 100 km that nobody touches. A file that is mapped into memory is as good as memory while there is enough of it,
and its pages go first where there is not.
"""

from __future__ import annotations

import mmap
import tempfile
from contextlib import suppress
from typing import Any
from weakref import WeakSet

import numpy as np
import torch
from torch import Tensor

from crowdmap_torch.processes.records import with_tensors

_LEAST = 1 << 16
"""Smaller tensors [bytes] stay where they are."""
_ALIGNED = 64
"""Tensors begin at multiples of so many bytes, as those that torch takes memory for."""
_PAGE_OUT = 21
"""`MADV_PAGEOUT` of Linux."""
_resting: WeakSet[mmap.mmap] = WeakSet()
"""The files that anything rests in."""


def rest(record: Any) -> Any:
    """The same record, its larger tensors on the processor in a file without a name, which goes when they do.

    They can be read and written like others; what is written stays in this process. Where no file can be made of them, on a
    full disk, the record stays in memory.
    """
    large = _large(record)
    if not large:
        return record
    with suppress(OSError), tempfile.TemporaryFile() as file:
        places = {}
        for tensor in large:
            file.seek(-(-file.tell() // _ALIGNED) * _ALIGNED)
            places[id(tensor)] = file.tell()
            file.write(tensor.contiguous().numpy().data)
        file.flush()
        length = file.tell()
        area = mmap.mmap(file.fileno(), length, access=mmap.ACCESS_COPY)
        _resting.add(area)
        mapped = np.frombuffer(area, dtype=np.uint8)

        def moved(tensor: Tensor) -> Tensor:
            first = places.get(id(tensor))
            if first is None:
                return tensor
            # A storage of its own for each: what is sent to another process is one tensor, not all of the file.
            part = torch.from_numpy(mapped[first : first + tensor.numel() * tensor.element_size()])
            return part.view(tensor.dtype).view(tensor.shape)

        return with_tensors(record, moved)
    return record


def leave() -> None:
    """Tells the system that nobody reads what rests for a while: it takes no memory of this process until somebody does.

    What was written since it rests stays (Linux; elsewhere nothing happens).
    """
    for area in list(_resting):
        with suppress(OSError, ValueError):
            area.madvise(_PAGE_OUT)


def _large(record: Any) -> list[Tensor]:
    """Each tensor that is worth it, once."""
    found: dict[int, Tensor] = {}

    def keep(tensor: Tensor) -> Tensor:
        size = tensor.numel() * tensor.element_size()
        if tensor.device.type == "cpu" and size >= _LEAST and not tensor.requires_grad:
            found[id(tensor)] = tensor
        return tensor

    with_tensors(record, keep)
    return list(found.values())
