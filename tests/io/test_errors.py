from __future__ import annotations

from crowdmap_torch.io.errors import InputError, one_line


def test_the_text_of_any_error_is_one_line():
    assert one_line(OSError("first\n  second\tthird ")) == "first second third"


def test_bad_input_is_a_value_error():
    assert isinstance(InputError("x"), ValueError)
