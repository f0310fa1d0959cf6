"""Every rule of FORMAT.md that can be broken has a likely cause and a cure."""

from __future__ import annotations

from typing import get_args

from crowdmap_torch.checking.causes import EXPLANATIONS
from crowdmap_torch.io.errors import Code


def test_every_code_of_a_fault_is_explained() -> None:
    assert {*get_args(Code)} == {*EXPLANATIONS}
