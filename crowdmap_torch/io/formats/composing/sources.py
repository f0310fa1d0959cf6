"""The files that stand behind one `--from`."""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.errors import InputError


def the_one(sources: tuple[Path, ...], expected: str) -> Path:
    """The only source of a format that is one file or folder."""
    if len(sources) != 1:
        raise InputError(f"{sources[1]}: a second source; expected one, {expected}")
    return sources[0]


def file_in(folder: Path, name: str) -> Path:
    """A file that a format's folder must hold; InputError if it is not there."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with {name} in it")
    if not (folder / name).exists():
        raise InputError(f"{folder / name}: the file is missing; is {folder} the right folder?")
    return folder / name
