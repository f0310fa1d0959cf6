"""The event files that TensorBoard shows while a map is being made."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.summary.writer.record_writer import RecordWriter
from torch import Tensor
from torch.utils.tensorboard.writer import SummaryWriter

from crowdmap_torch.report import plots
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.tables import HdMap, Survey

_MAX_SAMPLES = 200_000
"""Histograms are made of an even selection of at most this many numbers."""


class _Events:
    """An event file, written by whoever logs: an OSError is raised where it happens, not in a thread beside.

    What stands in the folder's other files, left by a run that was interrupted, is not written again.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._written = _written(folder)
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.{os.getpid()}"
        number = sum(path.name.startswith(name) for path in folder.iterdir())
        self._path = folder / f"{name}.{number}"
        self._file = self._path.open("wb")
        self._records = RecordWriter(self._file)
        self._add(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def add_summary(self, summary: Summary, global_step: int | None = None, *_: object) -> None:
        """What SummaryWriter hands over."""
        if not {(value.tag, global_step or 0) for value in summary.value} <= self._written:
            self._add(Event(wall_time=time.time(), step=global_step, summary=summary))

    def flush(self) -> None:
        """What is written is in the file already."""

    def close(self) -> None:
        """Closes the file."""
        with self._named():
            self._file.close()

    def _add(self, event: Event) -> None:
        with self._named():
            self._records.write(event.SerializeToString())
            self._records.flush()

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error


def _written(folder: Path) -> frozenset[tuple[str, int]]:
    """Tags and steps of all that the event files of a folder hold; one that was cut off is read up to there."""
    return frozenset(
        (value.tag, event.step)
        for path in sorted(folder.glob("events.out.tfevents.*"))
        for event in map(Event.FromString, RawEventFileLoader(str(path)).Load())
        for value in event.summary.value
    )


class _Writer(SummaryWriter):
    def _get_file_writer(self) -> _Events:  # pyright: ignore[reportIncompatibleMethodOverride]
        if self.file_writer is None:
            self.file_writer = _Events(Path(self.log_dir))
            self.all_writers = {self.log_dir: self.file_writer}
        return self.file_writer


class TensorBoardLog:
    """Writes one run's numbers by tags that are paths; a context manager that closes the file."""

    def __init__(self, folder: Path) -> None:
        """OSError, here as in all that follows, if the disk takes no more."""
        self._writer = _Writer(str(folder))

    def __enter__(self) -> TensorBoardLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Write what is buffered and close the event file."""
        self._writer.close()

    def log_config(self, config_yaml: str) -> None:
        """The configuration as text."""
        self.log_text("config", config_yaml)

    def log_text(self, tag: str, text: str) -> None:
        """Lines as they are."""
        # Four blanks make Markdown show them so.
        self._writer.add_text(tag, "\n".join(f"    {line}" for line in text.splitlines()))

    def log_iteration(
        self, iteration: Iteration, *, down_weighted: Mapping[str, float] | None = None
    ) -> None:
        """Cost of every term, damping, step, gain ratio and errors.

        `down_weighted` is the share of each term's observations that its robust kernel gives less
        than half its weight.
        """
        step = iteration.number
        scalars = {f"cost/{term}": cost for term, cost in iteration.cost.items()}
        scalars |= {
            "cost/total": iteration.total,
            "cost/before": iteration.cost_before,
            "solver/damping": iteration.damping,
            "solver/step_norm": iteration.step_norm,
            "solver/gain_ratio": iteration.gain_ratio,
            "solver/accepted": float(iteration.accepted),
        }
        scalars |= {f"robust/down_weighted_{k}": v for k, v in (down_weighted or {}).items()}
        self.log_scalars({**scalars, **iteration.errors}, step)

    def log_scalars(self, scalars: Mapping[str, float], step: int) -> None:
        """Numbers by tag; what is not finite is left out, as TensorBoard cannot draw it."""
        for tag, value in scalars.items():
            if math.isfinite(value):
                self._writer.add_scalar(tag, value, step)

    def log_histogram(self, tag: str, values: Float[Tensor, ...], step: int) -> None:
        """The distribution of residuals or weights; what is not finite is left out."""
        flat = values.detach().reshape(-1)
        flat = flat[flat.isfinite()]
        if len(flat) == 0:
            return
        flat = flat[:: max(len(flat) // _MAX_SAMPLES, 1)]
        self._writer.add_histogram(tag, flat.to(torch.float64).cpu().numpy(), step)

    def log_map(self, tag: str, hd_map: HdMap, survey: Survey | None, step: int) -> None:
        """The map from above, with the survey under it."""
        self.log_figure(tag, plots.plot_map(hd_map, survey), step)

    def log_figure(self, tag: str, figure: Figure, step: int) -> None:
        """A figure as an image."""
        # By its pixels: SummaryWriter.add_figure would need pyplot, which keeps every figure alive.
        self._writer.add_image(tag, plots.pixels(figure), step, dataformats="HWC")
