"""Standard streams that may be closed, full or left by their reader: whoever prints need not care."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from types import TracebackType
from typing import Any, TextIO, cast


class Forgiving:
    """A text stream whose first error is kept in `error`; from then on it takes whatever it is given to nowhere."""

    def __init__(self, stream: Any) -> None:
        """`None` is a stream that was closed before the program began: it takes everything."""
        self.error: OSError | None = None
        self._stream = open(os.devnull, "w", encoding="utf-8") if stream is None else stream

    def write(self, text: str) -> int:
        """Writes while that goes."""
        if self.error is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """Flushes while that goes."""
        if self.error is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def _give_up(self, error: OSError) -> None:
        self.error = error
        # What is still buffered would fail once more when Python ends.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)


class StandardStreams:
    """While it is entered, printing never fails; `output_fault` says what became of standard output."""

    def __enter__(self) -> StandardStreams:
        for number in range(3):
            # A file that is opened later would take the place of a stream that is closed, and be printed into.
            try:
                os.fstat(number)
            except OSError:
                os.open(os.devnull, os.O_RDWR)
        self._out, self._err = Forgiving(sys.stdout), Forgiving(sys.stderr)
        self._redirected = ExitStack()
        self._redirected.enter_context(redirect_stdout(cast(TextIO, self._out)))
        self._redirected.enter_context(redirect_stderr(cast(TextIO, self._err)))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._out.flush()
        self._err.flush()
        self._redirected.close()

    def output_fault(self) -> OSError | None:
        """Why what was printed did not all arrive, as far as that can be known now; BrokenPipeError: nobody reads it."""
        self._out.flush()
        return self._out.error
