"""The formats of GNSS fixes: tables, NMEA sentences, GPX."""

from __future__ import annotations

from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Parts, Track
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.io.formats.importers import csv, gpx, nmea
from crowdmap_torch.tables import Origin

MAY_DAY_NS = 1_777_593_600 * 10**9
COURSE = Asked(heading="course")


def read(module, folder: Path, text: str, asked: Asked | None = None) -> Parts:
    (folder / "fixes").write_text(text)
    return module.read((folder / "fixes",), asked or Asked())


def track(parts: Parts) -> Track:
    assert parts.track is not None
    return parts.track


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\n"


# ---- tables ----


def test_a_table_of_fixes_with_headings(tmp_path: Path):
    text = (
        "sigma_u,sigma_n,sigma_e,heading_deg,roll_deg,pitch_deg,lat_deg,lon_deg,height_m,t_s,frame,hdop\n"
        "0.3,0.2,0.1,90,0,0,48,11,500,1777593600.5,7,1\n"
        "0.3,0.2,0.1,90,0,5,48,11.0001,500,1777593601,9,1\n"
    )
    parts = read(csv, tmp_path, text)
    found = track(parts)
    assert parts.origin == Origin(48, 11, 500) and parts.notes == ()
    assert (found.world, found.link) == ("enu", "flu")
    assert found.t_ns.tolist() == [MAY_DAY_NS + 5 * 10**8, MAY_DAY_NS + 10**9]
    assert found.frame_number is not None and found.frame_number.tolist() == [7, 9]
    assert found.sigma_position is not None and found.sigma_position[0].tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_allclose(found.T_world_link[0, :3, 0], (1, 0, 0), atol=1e-12)
    assert found.T_world_link[1, 2, 0] == pytest.approx(np.sin(np.radians(5)))


def test_a_table_of_poses(tmp_path: Path):
    text = "t_ns,x,y,z,qx,qy,qz,qw,sigma_rot\n5,1,2,3,0,0,0,1,0.01\n"
    found = track(read(csv, tmp_path, text))
    assert (found.world, found.link) == (None, None)
    assert found.sigma_rotation is not None and found.sigma_rotation.tolist() == [0.01]
    level = read(csv, tmp_path, "t_ns,x,y,z,heading_deg\n5,1,2,3,0\n")
    assert track(level).link == "flu" and len(level.notes) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x,y,z\n1,2,3\n", "0 columns of times; expected one of t_s"),
        ("t_s,lat_deg,lon_deg\n1,2,3\n", "column 'height_m' is missing beside 'lat_deg'"),
        ("t_s,heading_deg\n1,2\n", "expected either columns lat_deg lon_deg height_m or x y z"),
        ("t_s,x,y,z\n1,2,3,4\n", "has no headings"),
        ("t_s,x,x\n1,2,3\n", "column 'x' is there twice"),
        ("t_s,lat_deg,lon_deg,height_m,heading_deg\n1,91,0,0,0\n", "line 2: expected a latitude"),
        (
            "t_s,lat_deg,lon_deg,height_m,qx,qy,qz,qw\n1,1,0,0,0,0,0,1\n",
            "to which axes do they turn",
        ),
        ("t_s,x,y,z,qx,qy,qz,qw,frame\n1,1,0,0,0,0,0,1,1.5\n", "line 2: frame: expected a whole"),
    ],
)
def test_a_table_with_a_mistake_is_refused(tmp_path: Path, text: str, expected: str):
    with pytest.raises(InputError, match=expected):
        read(csv, tmp_path, text)


# ---- NMEA ----


def epoch(clock: str, lat: str, *, heading: str = "90.0", quality: int = 4) -> str:
    return (
        sentence(f"GPGGA,{clock},{lat},N,01130.0000,W,{quality},12,0.8,450.0,M,50.0,M,,")
        + sentence(f"GPGST,{clock},1,,,,0.2,0.1,0.3")
        + sentence(f"GPHDT,{heading},T")
    )


DATE = sentence("GPRMC,235959.00,A,4800.0,N,01130.0,W,0.0,0.0,010526,,,A")


def test_sentences_become_fixes_also_through_midnight(tmp_path: Path):
    text = DATE + epoch("235959.50", "4800.0000") + epoch("000000.25", "4800.0060")
    parts = read(nmea, tmp_path, text)
    found = track(parts)
    assert parts.origin == Origin(48.0, -11.5, 500.0)
    assert found.t_ns.tolist() == [MAY_DAY_NS + 86_399_500_000_000, MAY_DAY_NS + 86_400_250_000_000]
    assert found.sigma_position is not None and found.sigma_position[0].tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_allclose(found.T_world_link[:, :3, 0], [(1, 0, 0)] * 2, atol=1e-12)
    place = local_from_geodetic(np.array([48.0001, -11.5, 500.0]), Origin(48.0, -11.5, 500.0))
    np.testing.assert_allclose(found.T_world_link[1, :3, 3], place, atol=1e-6)


def test_sentences_that_say_nothing_are_counted(tmp_path: Path):
    no_heading = epoch("000003.00", "4800.0030").splitlines(keepends=True)[0]
    broken = epoch("000004.00", "4800.0040").replace("4800.0040", "4800.0041")
    text = DATE + epoch("000001.00", "4800.0000") + epoch("000002.00", "", quality=0) + no_heading
    parts = read(nmea, tmp_path, text + broken.splitlines(keepends=True)[0])
    assert len(track(parts).t_ns) == 1
    assert parts.notes[:3] == (
        "1 sentences left out: their checksum is wrong",
        "1 GGA sentences without a fix",
        "1 fixes left out: without a heading",
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (DATE, "has no GGA sentence with a fix"),
        (epoch("000001.00", "4800.0"), "has no date; expected an RMC or ZDA"),
        (DATE + sentence("GPGGA,1,2"), "line 2: GGA with 3 values"),
        (DATE + epoch("12", "4800.0"), "line 2: time: expected hhmmss"),
        (DATE + epoch("000001", "4800.0").replace(",N,", ",X,").replace("*", " *"), "has no GGA"),
        (
            DATE + epoch("000002.0", "4800.0") + epoch("000001.0", "4800.0"),
            "line 5: its time is not after",
        ),
    ],
)
def test_sentences_with_a_mistake_are_refused(tmp_path: Path, text: str, expected: str):
    with pytest.raises(InputError, match=expected):
        read(nmea, tmp_path, text)


# ---- GPX ----


def gpx_of(*points: tuple[float, str]) -> str:
    inside = "".join(
        f'<trkpt lat="{lat}" lon="11"><ele>500</ele><time>{time}</time></trkpt>'
        for lat, time in points
    )
    return (
        f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{inside}</trkseg></trk></gpx>'
    )


def test_points_of_a_track_head_where_they_go(tmp_path: Path):
    text = gpx_of((48.0, "2026-05-01T00:00:00Z"), (48.0001, "2026-05-01T00:00:01.5Z"))
    parts = read(gpx, tmp_path, text, COURSE)
    found = track(parts)
    assert parts.origin == Origin(48, 11, 500)
    assert found.t_ns.tolist() == [MAY_DAY_NS, MAY_DAY_NS + 1_500_000_000]
    np.testing.assert_allclose(found.T_world_link[0, :3, 0], (0, 1, 0), atol=1e-6)
    with pytest.raises(InputError, match="has no headings"):
        read(gpx, tmp_path, text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<gpx/>", "has no track points"),
        (
            gpx_of((480.0, "2026-05-01T00:00:00Z")),
            "track point 1: lat: expected a number, 90 at most",
        ),
        (gpx_of((48.0, "noon")), "track point 1: time: expected"),
        (
            gpx_of((48.0, "2026-05-01T00:00:00Z"), (48.0, "2026-05-01T00:00:00Z")),
            "point 2: its time",
        ),
    ],
)
def test_a_track_with_a_mistake_is_refused(tmp_path: Path, text: str, expected: str):
    with pytest.raises(InputError, match=expected):
        read(gpx, tmp_path, text, COURSE)
