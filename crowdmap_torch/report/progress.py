"""Progress on the terminal: one line that is rewritten where there is a terminal, plain lines where there is none.

What each stage took is kept: its time, and the most memory that this process held in it.
"""

from __future__ import annotations

import sys
import time
from io import TextIOBase

from crowdmap_torch.processes.memory import peak_bytes, restart_peak

_PLAIN_EVERY_S = 10.0
"""Without a terminal a stage says no more often how far it is."""


class Progress:
    """Says which stage runs, how far it is, and when it will be done; keeps each stage's seconds and memory.

    A stage that comes back, as where an adjustment begins again, adds to its seconds.
    """

    def __init__(self, stream: TextIOBase | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.peak_gb: dict[str, float] = {}
        """Of this process alone; empty where nobody tells."""
        self._stream = sys.stderr if stream is None else stream
        self._rewrites = self._stream.isatty()
        self._stage = ""
        self._earlier = 0.0
        """Seconds of the stage when it ran before."""
        self._begun_at = 0
        """Steps of it that were finished when it began."""
        self._started = time.monotonic()
        self._said = self._started

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        """Tell that `done` of `total` steps of a stage are finished; a new name starts a new stage."""
        now = time.monotonic()
        if stage != self._stage:
            self.finish()
            self._stage, self._started, self._begun_at = stage, now, done
            self._earlier = self.seconds.get(stage, 0.0)
            restart_peak()
        elapsed = now - self._started
        self.seconds[stage] = self._earlier + elapsed
        text = stage if not total else f"{stage} {done}/{total}"
        if self._begun_at < done < total:
            text += f", {elapsed * (total - done) / (done - self._begun_at):.0f} s left"
        if note:
            text += f", {note}"
        if self._rewrites:
            self._stream.write(f"\r\x1b[K{text}")
        elif not total or done == total or now - self._said > _PLAIN_EVERY_S:
            self._stream.write(f"{text}\n")
            self._said = now
        self._stream.flush()

    def finish(self) -> None:
        """End the stage that runs, and its line."""
        if not self._stage:
            return
        self.seconds[self._stage] = self._earlier + time.monotonic() - self._started
        if (peak := peak_bytes()) is not None:
            self.peak_gb[self._stage] = max(self.peak_gb.get(self._stage, 0.0), peak / 1e9)
        if self._rewrites:
            self._stream.write(f"\r\x1b[K{self._stage}: {self.seconds[self._stage]:.1f} s\n")
            self._stream.flush()
        self._stage = ""
