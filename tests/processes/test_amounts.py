"""How much is computed at once on each device."""

import torch

from crowdmap_torch.processes.amounts import at_once


def test_a_gpu_is_given_more_at_once_than_a_processor():
    assert at_once(100, torch.device("cpu")) == 100
    assert at_once(100, torch.device("cuda:1")) > 1000


def test_large_units_come_one_by_one_and_small_ones_together():
    cpu = torch.device("cpu")
    assert at_once(100, cpu, each=30) == 3
    assert at_once(100, cpu, each=1000) == 1
    assert at_once(100, cpu, each=0) == 100
