"""Signals that end the program: one line on standard error, 128 and the signal's number as exit code, nothing half done.

A signal leaves the work as an exception where the main thread is, so that whatever was begun is cleared away. Long
calls outside Python, and code that swallows exceptions, do not hinder it: a thread beside ends the process after a grace.
Renames that belong together are `held`: a signal waits for them. It waits for modules that are `loading`, too.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

GRACE_S = 2.0
"""How long clearing away may take before the process ends without it."""
_AGAIN_S = 0.02
"""After this time an interruption that was swallowed is tried again."""
_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_RENAMING = threading.RLock()
"""Taken by whoever renames files that belong together."""


class Interrupted(KeyboardInterrupt):
    """A signal that ends the program."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class Interruptible:
    """While it is entered, in the main thread, signals end the program; `number` is that of the signal, 0 for none.

    It swallows the exception that a signal left as, whatever became of it on its way: the caller ends with
    `128 + number`. A process that is told to end does: within `GRACE_S` it is ended from a thread beside.
    """

    number = 0

    def __init__(self, say: Callable[[str], object], *, last: bool = False) -> None:
        """`say` is told the signal's name, once, as the last thing.

        `last`: the process ends after it, with the work's exit code, whatever signals come once the work is done.
        """
        self._say = say
        self._last = last
        self._said = threading.Lock()
        self._before: dict[int, Callable | int | None] = {}
        self._waits = False
        self._depth = 0
        self._done = False

    def __enter__(self) -> Interruptible:
        global _active
        if threading.current_thread() is not threading.main_thread() or _active is not None:
            return self
        _kept.clear()
        self._reads, self._writes = os.pipe()
        os.set_blocking(self._writes, False)
        self._wakeup = signal.set_wakeup_fd(self._writes, warn_on_full_buffer=False)
        self._unraisable = sys.unraisablehook
        sys.unraisablehook = self._on_unraisable
        _active = self
        self._watch = threading.Thread(target=self._end_late, name="signals", daemon=True)
        self._watch.start()
        for number in _SIGNALS:
            # What `nohup` has switched off stays off; scripts switch SIGINT off for whatever they start beside.
            if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        global _active
        if _active is not self:
            return False
        self._depth += 1
        self._done = self._last and kind is None and not self.number
        if self.number:
            # The thread beside goes on watching: what Python does at its end may hang too.
            self._speak()
            return True
        if self._done:
            return False
        for number, before in self._before.items():
            signal.signal(number, before)
        signal.set_wakeup_fd(self._wakeup)
        sys.unraisablehook = self._unraisable
        os.write(self._writes, bytes(1))
        self._watch.join()
        os.close(self._reads)
        os.close(self._writes)
        _active = None
        return False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._done or (self.number and not self._waits):
            # It is on its way out.
            return
        self.number = self.number or number
        self._waits = self._depth > 0
        if not self._waits:
            raise Interrupted(self.number)

    def _on_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        if not isinstance(unraisable.exc_value, Interrupted):
            self._unraisable(unraisable)
            return
        # It came in a callback that cannot hand exceptions on, such as a finalizer.
        self._waits = True
        main = threading.main_thread().ident
        again = threading.Timer(_AGAIN_S, signal.pthread_kill, (main, self.number))
        again.daemon = True
        again.start()

    def hold(self) -> None:
        """From now on signals wait."""
        self._depth += 1

    def release(self) -> None:
        """Signals need not wait any longer; Interrupted if one has waited."""
        self._depth -= 1
        if self._waits and not self._depth:
            self._waits = False
            raise Interrupted(self.number)

    def _end_late(self) -> None:
        number = 0
        while number not in _SIGNALS:
            number = os.read(self._reads, 1)[0]
            if not number:
                return
        time.sleep(GRACE_S)
        _RENAMING.acquire(timeout=1)
        self.number = self.number or number
        self._speak()
        os._exit(128 + number)

    def _speak(self) -> None:
        if self._said.acquire(blocking=False):
            # Whoever should read the line may have stopped to read.
            name = signal.Signals(self.number).name
            speaker = threading.Thread(target=self._say, args=(name,), daemon=True)
            speaker.start()
            speaker.join(0.5)


_active: Interruptible | None = None
_kept: list[Callable[[], str]] = []


@contextmanager
def loading() -> Iterator[None]:
    """Inside, a signal waits, for `GRACE_S` at most: modules of other languages may abort when their loading is left."""
    signals = _active if threading.current_thread() is threading.main_thread() else None
    if signals is not None:
        signals.hold()
    try:
        yield
    finally:
        if signals is not None:
            signals.release()


@contextmanager
def held() -> Iterator[None]:
    """Inside, a signal waits: for the few renames that belong together, not for work."""
    with loading(), _RENAMING:
        yield


@contextmanager
def keeping(what: Callable[[], str]) -> Iterator[None]:
    """Inside, `kept` says this: what is left of the work should it end before its time, and how it goes on.

    It stays said if an exception leaves.
    """
    _kept.append(what)
    yield
    _kept.remove(what)


def kept() -> str:
    """What is left of the work that runs."""
    return _kept[-1]() if _kept else "nothing half-written is left"
