"""Records whose tensors rest in a file, or go elsewhere: the same numbers, and no more memory than is theirs."""

from __future__ import annotations

import pickle
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from crowdmap_torch.processes import at_rest
from crowdmap_torch.processes.at_rest import leave, rest
from crowdmap_torch.processes.records import alone


@dataclass(frozen=True)
class Held:
    name: str
    column: Tensor
    parts: tuple[Tensor, ...]
    more: dict[str, Any]


def held(rows: int = 30_000) -> Held:
    generator = torch.Generator().manual_seed(0)
    column = torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    flags = column[:, 0] > 0
    return Held("x", column, (column.mT, flags, flags[:3]), {"n": torch.arange(rows), "none": None})


def tensors(of: Held) -> list[Tensor]:
    return [of.column, *of.parts, of.more["n"]]


def test_a_record_at_rest_is_the_same() -> None:
    made = held()
    resting = rest(made)
    for one, other in zip(tensors(made), tensors(resting), strict=True):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert torch.equal(one, other)
    assert resting.name == "x" and resting.more["none"] is None
    # Small ones are not worth a file.
    assert resting.parts[2] is made.parts[2]
    assert resting.column.data_ptr() != made.column.data_ptr()
    assert resting.column.data_ptr() % 64 == 0


def test_nothing_large_stays_as_it_is() -> None:
    small = held(10)
    assert rest(small) is small
    assert rest(None) is None


def test_what_is_written_is_kept_and_goes_no_further() -> None:
    made = held()
    resting = rest(made)
    resting.column[0, 0] = 7.0
    assert float(resting.column[0, 0]) == 7.0
    assert float(made.column[0, 0]) != 7.0


def test_what_is_sent_is_as_large_as_its_tensors() -> None:
    resting = rest(held())
    sent = pickle.dumps(resting.more["n"])
    assert len(sent) < 1.1 * 30_000 * 8
    assert torch.equal(pickle.loads(sent), resting.more["n"])


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="memory is read from /proc")
def test_memory_is_a_files() -> None:
    def anonymous(tensor: Tensor) -> int:
        """Kilobytes of the mappings that hold the tensor that are this process's alone, not a file's.

        There are several where some of it lies where NumPy once asked for large pages.
        """
        begin, total, holds = tensor.data_ptr(), [], False
        for line in Path("/proc/self/smaps").read_text().splitlines():
            name, _, rest_of_line = line.partition(" ")
            if not name.endswith(":"):
                first, _, last = name.partition("-")
                holds = int(first, 16) < begin + tensor.nbytes and begin < int(last, 16)
            elif holds and name == "Anonymous:":
                total.append(int(rest_of_line.split()[0]))
        assert total, "no mapping holds the tensor"
        return sum(total)

    given = torch.ones(8_000_000, dtype=torch.float64)
    resting = rest(Held("x", given, (), {}))
    assert float(resting.column.sum()) == 8e6
    assert anonymous(given) >= 62_500
    assert anonymous(resting.column) == 0
    resting.column[:1000] = 2.0
    assert 0 < anonymous(resting.column) < 64


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux can be told to")
def test_what_is_left_takes_no_memory_until_it_is_read() -> None:
    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    resting = rest(Held("x", torch.ones(8_000_000, dtype=torch.float64), (), {}))
    resting.column[:1000] = 7.0
    assert float(resting.column.sum()) == 8e6 + 6e3
    before = resident_mb()
    leave()
    assert before - resident_mb() > 50
    assert float(resting.column.sum()) == 8e6 + 6e3
    assert before - resident_mb() < 10


def test_where_there_is_no_disk_it_stays_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    made = held()
    assert at_rest.rest(made) is made


def test_what_goes_alone_takes_nothing_else_along() -> None:
    made = held()
    part = Held("x", made.column[:10], (made.parts[1],), {"n": made.more["n"][5:6]})
    sent = alone(part)
    assert len(pickle.dumps(sent.column)) < 1000 < len(pickle.dumps(part.column))
    for one, other in zip(tensors(part), tensors(sent), strict=True):
        assert torch.equal(one, other)
    # What is whole already is not copied.
    assert sent.parts[0] is part.parts[0]
