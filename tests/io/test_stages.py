"""Files of finished stages: complete, of the right run, or refused without running anything."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.io.stages import read_stage, write_stage


@dataclass(frozen=True)
class Table:
    at: Float[Tensor, "n 2"]
    count: int


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    path = tmp_path / "stages" / "table.pt"
    write_stage(path, Table(torch.eye(2), 3), key="mine")
    return path


def disguised(path: Path, content: bytes) -> None:
    """Writes what claims to be a stage, its hash right."""
    head = b"crowdmap stage 1\n" + hashlib.sha256(content).hexdigest().encode() + b"\n"
    path.write_bytes(head + content)


def test_a_stage_comes_back(kept: Path):
    table = read_stage(kept, Table, key="mine")
    assert torch.equal(table.at, torch.eye(2)) and table.count == 3
    assert [p.name for p in kept.parent.iterdir()] == ["table.pt"]


def test_no_stage_is_none(tmp_path: Path):
    assert read_stage(tmp_path / "table.pt", Table, key="mine") is None


def test_of_something_else_it_is_refused(kept: Path):
    with pytest.raises(ValueError, match="made from something else"):
        read_stage(kept, Table, key="yours")


def test_every_flipped_byte_and_every_cut_is_noticed(kept: Path, generator: torch.Generator):
    whole = kept.read_bytes()
    for at in torch.randint(len(whole), (40,), generator=generator).tolist():
        spoilt = bytearray(whole)
        spoilt[at] ^= 1 << at % 8
        for content in (bytes(spoilt), whole[:at]):
            kept.write_bytes(content)
            with pytest.raises(ValueError, match=r"table\.pt: is cut off, damaged"):
                read_stage(kept, Table, key="mine")


class Malicious:
    """What would make a file when it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_no_code_is_run(kept: Path, tmp_path: Path):
    trap = tmp_path / "trap"
    content = io.BytesIO()
    torch.save({"key": "mine", "tree": Malicious(trap)}, content)
    for evil in (content.getvalue(), pickle.dumps(Malicious(trap)), b"", b"PK\x03\x04"):
        disguised(kept, evil)
        with pytest.raises(ValueError, match=r"table\.pt: cannot be read") as error:
            read_stage(kept, Table, key="mine")
        assert "\n" not in str(error.value) and not trap.exists()


@pytest.mark.parametrize(
    "tree",
    [None, {"at": torch.eye(2)}, {"at": torch.eye(3), "count": 3}, {"at": 1, "count": "three"}],
)
def test_of_another_class_it_is_refused(kept: Path, tree: object):
    content = io.BytesIO()
    torch.save({"key": "mine", "tree": tree}, content)
    disguised(kept, content.getvalue())
    with pytest.raises(ValueError, match=r"table\.pt: Table.*expected"):
        read_stage(kept, Table, key="mine")


def test_what_is_no_file_is_not_read(tmp_path: Path, kept: Path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(kept)
    for path in (pipe, link, tmp_path):
        with pytest.raises(ValueError, match="no link or device"):
            read_stage(path, Table, key="mine")


def test_writing_that_fails_leaves_the_old_one(kept: Path):
    before = kept.read_bytes()
    with pytest.raises(TypeError, match="cannot be kept"):
        write_stage(kept, object(), key="mine")
    assert kept.read_bytes() == before
    assert [p.name for p in kept.parent.iterdir()] == ["table.pt"]
