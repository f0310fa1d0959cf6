"""Tasks that kill the process that does them."""

from __future__ import annotations

import os
import signal
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from crowdmap_torch.io.stored_drives import StoredDrive
from crowdmap_torch.tables import Journey

T = TypeVar("T")


def dies_when_asked(folder: Path) -> None:
    """Leaves a file and kills its process."""
    (folder / uuid.uuid4().hex).touch()
    os.kill(os.getpid(), signal.SIGKILL)


def dies_at_first(marker: Path, result: T) -> T:
    """The result; the first to ask, who makes the marker, is killed."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return result


@dataclass(frozen=True)
class MortalDrive(StoredDrive):
    """A drive whose first reader is killed."""

    marker: Path

    def read(self) -> Journey:
        """The drive."""
        return dies_at_first(self.marker, self).as_it_is()

    def as_it_is(self) -> Journey:
        """What lies there."""
        return super().read()
