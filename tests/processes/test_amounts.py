"""How much is computed at once on each device."""

import torch

from crowdmap_torch.processes.amounts import at_once


def test_a_gpu_is_given_more_at_once_than_a_processor():
    assert at_once(100, torch.device("cpu")) == 100
    assert at_once(100, torch.device("cuda:1")) > 1000
