from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from crowdmap_torch.report.checkpoints import load_checkpoint, save_checkpoint


class Unknowns(nn.Module):
    def __init__(self, signs: int) -> None:
        super().__init__()
        self.pose = nn.Parameter(torch.zeros(5, 6, dtype=torch.float64))
        self.register_buffer("base", torch.eye(4, dtype=torch.float64).repeat(signs, 1, 1))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    module = Unknowns(3)
    with torch.no_grad():
        module.pose.add_(1.5)
    path = tmp_path / "checkpoints" / "last.pt"
    save_checkpoint(
        path, module, config_hash="abc", iteration=7, state={"damping": torch.tensor([1e-3])}
    )
    return path


def test_a_checkpoint_brings_everything_back(saved: Path):
    module = Unknowns(3)
    checkpoint = load_checkpoint(saved, module, config_hash="abc")
    assert checkpoint.iteration == 7
    assert checkpoint.state["damping"].item() == pytest.approx(1e-3)
    assert (module.pose == 1.5).all()
    assert module.pose.requires_grad


def test_another_configuration_is_refused(saved: Path):
    with pytest.raises(ValueError, match="saved with configuration abc, not abd"):
        load_checkpoint(saved, Unknowns(3), config_hash="abd")


def test_another_problem_is_refused(saved: Path):
    with pytest.raises(ValueError, match="'base' does not fit"):
        load_checkpoint(saved, Unknowns(4), config_hash="abc")
    with pytest.raises(ValueError, match="does not fit"):
        load_checkpoint(saved, nn.Linear(2, 2), config_hash="abc")


def test_a_broken_file_is_refused_in_one_line(saved: Path):
    saved.write_bytes(saved.read_bytes()[:100])
    with pytest.raises(ValueError, match="not a checkpoint") as error:
        load_checkpoint(saved, Unknowns(3), config_hash="abc")
    assert "\n" not in str(error.value)


def test_saving_that_fails_leaves_the_old_checkpoint(saved: Path):
    before = saved.read_bytes()
    with pytest.raises(Exception, match="pickle"):
        save_checkpoint(
            saved, Unknowns(3), config_hash="abc", iteration=8, state={"bad": lambda: None}
        )
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == ["last.pt"]
