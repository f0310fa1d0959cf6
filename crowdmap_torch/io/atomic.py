"""Files and folders that are complete or not there: written beside their place, then renamed."""

from __future__ import annotations

import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crowdmap_torch.processes.interrupts import held

_BESIDE = re.compile(r"\..+\.[0-9a-f]{12}\.part")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A path to write to; it becomes `path` if the block ends well and disappears if not.

    OSError, with `path`, if the block or the renaming fails.
    """
    beside = _beside(path, "part")
    try:
        with _named(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield beside
            os.replace(beside, path)
    finally:
        with held():
            beside.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty folder to write to; it becomes `path` if the block ends well and disappears if not.

    What was at `path` before stays untouched until the block has ended, and is put back should the
    renaming fail. OSError, with a path, if the block or the renaming fails.
    """
    beside = _beside(path, "part")
    try:
        with _named(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            beside.mkdir()
            yield beside
            with held():
                _replace_folder(beside, path)
    finally:
        with held():
            shutil.rmtree(beside, ignore_errors=True)


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path`; it disappears with what is left in it when the block ends."""
    beside = _beside(path, "part")
    try:
        with _named(path):
            beside.mkdir()
            yield beside
    finally:
        with held():
            shutil.rmtree(beside, ignore_errors=True)


def drop_halves(folder: Path) -> None:
    """Removes what writers that were killed have left half-written in a folder and below; none may be writing there now."""
    for path in list(folder.rglob("*.part")):
        if _BESIDE.fullmatch(path.name):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Inside, an OSError that does not say which file it is about is about `path`."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        # A disk that is full says so without a name; Arrow wraps it into a longer text.
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


def _replace_folder(new: Path, path: Path) -> None:
    if not os.path.lexists(path):
        new.rename(path)
        return
    # A folder cannot be renamed over another that has files in it: the old one steps aside first.
    old = _beside(path, "old")
    path.rename(old)
    try:
        new.rename(path)
    except OSError:
        old.rename(path)
        raise
    if old.is_dir() and not old.is_symlink():
        shutil.rmtree(old)
    else:
        old.unlink()


def _beside(path: Path, ending: str) -> Path:
    """A name in the same folder, and so on the same file system, that nobody else uses."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.{ending}")
