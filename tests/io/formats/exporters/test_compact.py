from __future__ import annotations

from pathlib import Path

import pytest
import torch
from worlds.marked_roads import bend, marked_map, two_way_road

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.exporters.compact import MAGIC, read_compact, write
from crowdmap_torch.tables import HdMap


def close(a: torch.Tensor, b: torch.Tensor, atol: float) -> None:
    torch.testing.assert_close(a, b, rtol=0, atol=atol)


@pytest.mark.parametrize("bare", [False, True])
def test_a_map_comes_back(hd_map: HdMap, bare: bool, tmp_path: Path):
    given = marked_map([]) if bare else hd_map
    write(given, tmp_path / "map.cmap")
    back = read_compact(tmp_path / "map.cmap")
    assert (back.sign_id, back.lane_id, back.type_names) == (
        given.sign_id,
        given.lane_id,
        given.type_names,
    )
    assert (back.origin, back.provenance) == (given.origin, given.provenance)
    close(back.shared_covariance, given.shared_covariance, 0)
    lanes = given.lanes.select(torch.arange(len(given.lanes)))
    for name in ("shape", "type", "n_journeys", "n_observations", "first_seen_ns", "last_seen_ns"):
        assert torch.equal(getattr(back.signs, name), getattr(given.signs, name))
        if name != "shape":
            assert torch.equal(getattr(back.lanes, name), getattr(lanes, name))
    assert torch.equal(back.lanes.control_count, lanes.control_count)
    close(back.lanes.control.point_world, lanes.control.point_world, 6e-5)
    close(back.lanes.control.sigma, lanes.control.sigma, 1e-6)
    # Half a step each of place and size, and a turn of 1e-7.
    close(back.signs.corners_world, given.signs.corners_world, 3e-4)
    close(back.signs.confidence, given.signs.confidence, 1e-7)
    torch.testing.assert_close(back.signs.covariance, given.signs.covariance, rtol=1e-6, atol=1e-7)


def test_a_kilometre_takes_few_bytes(tmp_path: Path):
    markers = [("solid", bend(640, 90, aside)[::5]) for aside in (0.0, 3.5, 7.0, 10.5)]
    signs = [("US:R1-1", (float(k), 0.0, 2.0, 10.0 * k)) for k in range(45)]
    write(marked_map(markers, signs), tmp_path / "map.cmap")
    # Four markers of a kilometre, control points 5 m apart, and 45 signs.
    assert (tmp_path / "map.cmap").stat().st_size < 10_000


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b[:-9],
        lambda b: b[:40],
        lambda b: b[:80] + b"?" + b[81:],
        lambda b: MAGIC,
        lambda b: b"PK",
        None,
    ],
    ids=["end", "beginning", "middle", "empty", "other", "missing"],
)
def test_a_damaged_file_is_one_line(spoil, tmp_path: Path):
    path = tmp_path / "map.cmap"
    write(two_way_road(), path)
    content = path.read_bytes()
    path.unlink()
    if spoil is not None:
        path.write_bytes(spoil(content))
    with pytest.raises(InputError, match=r"map\.cmap: ") as said:
        read_compact(path)
    assert "\n" not in str(said.value)
