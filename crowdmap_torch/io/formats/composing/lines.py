"""Text files with a row a line: numbers checked as they are taken; complaints name the file and the line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.budget import read_text
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.ranges import shown

_LARGEST = 1e12
"""Of any number that is not a time: what is larger is a slip."""
_UNITS_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in each unit of time."""
TIME_UNITS = tuple(_UNITS_NS)


@dataclass(frozen=True)
class Line:
    """The cells of one line of a file."""

    path: Path
    number: int
    """From 1."""
    cells: tuple[str, ...]

    def fault(self, rule: str) -> InputError:
        """The error that says in which line of which file a rule is broken."""
        return InputError(f"{self.path}: line {self.number}: {rule}")

    def real(self, cell: int, name: str) -> float:
        """A finite number."""
        try:
            value = float(self.cells[cell])
        except ValueError:
            value = math.nan
        if not abs(value) <= _LARGEST:
            raise self.fault(f"{name}: expected a finite number, found {shown(self.cells[cell])}")
        return value

    def time_ns(self, cell: int, unit: str) -> int:
        """A time in nanoseconds, exact whatever the unit."""
        try:
            return time_ns(self.cells[cell], unit)
        except ValueError as error:
            raise self.fault(one_line(error)) from error


def time_ns(text: str, unit: str) -> int:
    """A time as it is written, in nanoseconds; ValueError says what was expected."""
    try:
        exact = Decimal(text) * _UNITS_NS[unit]
        ns = int(exact.to_integral_value()) if exact.is_finite() else None
    except (InvalidOperation, OverflowError):
        ns = None
    if ns is None or abs(ns) > 2**61:
        raise ValueError(f"time: expected a number of {unit}, found {shown(text)}")
    return ns


def read_lines(path: Path) -> Iterator[Line]:
    """Lines that are not empty and no comment, split at commas, semicolons, tabs or spaces."""
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        if text.strip() and not text.lstrip().startswith(("#", "%")):
            yield Line(path, number, tuple(re.split(r"\s*[,;]\s*|\s+", text.strip())))


def read_numbers(path: Path, counts: Sequence[int], expected: str) -> list[Line]:
    """Lines of as many cells as `counts` allows, one line at least."""
    lines = []
    for line in read_lines(path):
        if len(line.cells) not in counts:
            raise line.fault(f"expected {expected}, found {len(line.cells)} values")
        lines.append(line)
    if not lines:
        raise InputError(f"{path}: has no rows; expected lines of {expected}")
    return lines


def read_table(path: Path) -> tuple[tuple[str, ...], list[Line]]:
    """The names of the columns of a CSV with a header, in lower case, and its rows."""
    try:
        reader = csv.reader(read_text(path).splitlines(), skipinitialspace=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({one_line(error)})") from error
    if len(rows) < 2:
        raise InputError(f"{path}: has no rows; expected a line of names and lines of values")
    head = tuple(cell.strip().lstrip("#").strip().lower() for cell in rows[0][1])
    lines = [Line(path, number, tuple(cell.strip() for cell in row)) for number, row in rows[1:]]
    for line in lines:
        if len(line.cells) != len(head):
            raise line.fault(f"expected {len(head)} values, found {len(line.cells)}")
    return head, lines


def columns(lines: Sequence[Line], first: int, names: Sequence[str]) -> Float[np.ndarray, "n k"]:
    """Finite numbers of neighbouring cells."""
    rows = [[line.real(first + k, name) for k, name in enumerate(names)] for line in lines]
    return np.array(rows, dtype=np.float64).reshape(len(lines), len(names))


def times(lines: Sequence[Line], cell: int, unit: str) -> Int[np.ndarray, " n"]:
    """Times [ns] that grow from line to line."""
    found = [line.time_ns(cell, unit) for line in lines]
    for before, now, line in zip(found, found[1:], lines[1:], strict=False):
        if now <= before:
            raise line.fault(
                f"its time {line.cells[cell]} is not after that of the line before; expected one row "
                "for each time, in order: sort the file and take out what is there twice"
            )
    return np.array(found, dtype=np.int64)


def poses(
    lines: Sequence[Line],
    position: Float[np.ndarray, "n 3"],
    quaternion_xyzw: Float[np.ndarray, "n 4"],
) -> Float[np.ndarray, "n 4 4"]:
    """Transforms of positions and unit quaternions."""
    length = np.sqrt(np.square(quaternion_xyzw).sum(-1))
    off = np.abs(length - 1) > _UNIT_TOLERANCE
    if off.any():
        row = int(off.argmax())
        raise lines[row].fault(
            f"the quaternion has length {length[row]:.6g}; expected 1. Is this file's order of columns "
            "that of the format?"
        )
    T = np.tile(np.eye(4), (len(lines), 1, 1))
    T[:, :3, :3] = rotations(quaternion_xyzw)
    T[:, :3, 3] = position
    return T


def rotations(quaternion_xyzw: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of quaternions, normalised first."""
    return se3.from_quaternion(torch.from_numpy(quaternion_xyzw)).numpy()


_UNIT_TOLERANCE = 1e-2
"""Text files round: how far from 1 the length of a quaternion may be before it is normalised."""
