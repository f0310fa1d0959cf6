from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.viewer.columns import Column, column, encoded, packed, unpacked


@pytest.mark.parametrize("difference", [None, "rows", "pairs"])
@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6])
def test_numbers_come_back_to_half_a_step(difference: str | None, scale: float) -> None:
    values = scale * np.random.default_rng(0).standard_normal((50, 4, 2))
    _, found = unpacked(packed({}, {"a": Column(values, 0.01, difference)}))
    # Half a step, and rounding of the numbers themselves.
    assert np.abs(found["a"] - values.reshape(50, 8)).max() <= 0.005 * (1 + 1e-6) + 1e-15 * scale


def test_floats_are_kept_as_floats() -> None:
    values = np.array([[1e-9, 3.0], [np.pi, -1e9]])
    _, found = unpacked(packed({}, {"a": Column(values, 0)}))
    assert np.array_equal(found["a"], values.astype(np.float32))


def test_columns_without_rows_come_back() -> None:
    columns = {"a": Column(np.zeros((0, 3)), 0.1, "rows"), "b": column(np.arange(3))}
    head, found = unpacked(packed({"title": "x"}, columns))
    assert head == {"title": "x"} and found["a"].shape == (0, 3)
    assert found["b"][:, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_numbers_that_cannot_be_kept_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=r"^lanes: a number is (not finite|beyond)"):
        packed({}, {"lanes": Column(np.array([[0.0], [bad]]), 0.001)})


def test_neighbours_too_far_apart_are_refused() -> None:
    far = np.array([[-2e9], [2e9]])
    with pytest.raises(ValueError, match="path: neighbours are further apart"):
        packed({}, {"path": Column(far, 1.0, "rows")})


def test_a_payload_ends_no_script() -> None:
    text = encoded(packed({"id": "</script>" * 100}, {}))
    assert not set(text) & set("<>&:\"'")
