"""Rigs: what comes out of a sound one, and which line names each fault."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.rigs import read_rig


def read(sound, name: str = "a"):
    return read_rig(sound.write() / "rigs" / name)


def test_a_rig_is_read_as_it_stands(sound) -> None:
    rig = read(sound)
    assert rig.rig_id == "a"
    assert rig.camera.K.tolist() == [[100, 0, 59.5], [0, 100, 39.5], [0, 0, 1]]
    assert (rig.camera.width, rig.camera.height) == (120, 80)
    assert rig.road_normal_camera.tolist() == [0, 1, 0]
    assert rig.camera_height == 1.45
    # The camera looks forward: its z is the vehicle's x.
    z_link = rig.T_link_camera[:3, 2]
    torch.testing.assert_close(z_link, torch.tensor([1.0, 0, 0], dtype=torch.float64))


def test_without_a_mount_the_poses_are_the_cameras_own(sound) -> None:
    assert torch.equal(read(sound, "b").T_link_camera, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize(
    ("model", "count"),
    [("brown_conrady", n) for n in (0, 4, 5, 8, 12, 14)] + [("kannala_brandt", 4)],
)
def test_every_number_of_coefficients_of_the_format_is_read(sound, model, count) -> None:
    sound.rigs["b"]["camera"] |= {"model": model, "distortion": [1e-5] * count}
    assert read(sound, "b").camera.distortion.tolist() == [1e-5] * count


def test_numbers_as_python_writes_them_are_numbers(sound) -> None:
    # YAML 1.1 takes 1e-05 for a text.
    text = yaml.safe_dump(sound.rigs["b"]).replace(
        "distortion: []", "distortion: [1e-05, 0, -2E-6, 0]"
    )
    assert "1e-05" in text
    sound.rigs["b"] = text
    assert read(sound, "b").camera.distortion.tolist() == [1e-5, 0, -2e-6, 0]


def camera(**changes: object):
    return lambda t: t.rigs["a"]["camera"].update(changes)


def road(**changes: object):
    return lambda t: t.rigs["a"]["road"].update(changes)


def mount(**changes: object):
    return lambda t: t.rigs["a"]["mount"].update(changes)


def yaml_text(text: str | None):
    return lambda t: t.rigs.update(a=text)


def urdf(old: str, new: str):
    return lambda t: t.urdfs.update(a=t.urdfs["a"].replace(old, new))


FAULTS = {
    "missing": (yaml_text(None), "rig.yaml: the file is missing"),
    "no yaml": (yaml_text("camera: [1"), "rig.yaml: cannot be read as YAML"),
    "a list": (yaml_text("- 1"), "rig.yaml: expected a mapping"),
    "key twice": (yaml_text("road: 1\nroad: 2\n"), "line 2: key 'road' is given twice"),
    "unknown key": (
        lambda t: t.rigs["a"].update(lidar={}),
        "key 'lidar' is unknown; expected camer",
    ),
    "unknown camera key": (camera(skew=0.0), "camera: key 'skew' is unknown"),
    "unknown road key": (road(slope=0.0), "road: key 'slope' is unknown"),
    "unknown mount key": (mount(link="x"), "mount: key 'link' is unknown"),
    "no road": (lambda t: t.rigs["a"].pop("road"), "key 'road' is missing"),
    "no fx": (lambda t: t.rigs["a"]["camera"].pop("fx"), "camera: key 'fx' is missing"),
    "no normal": (lambda t: t.rigs["a"]["road"].pop("normal"), "road: key 'normal' is missing"),
    "model": (camera(model="pinhole"), "camera.model: expected one of brown_conrady, kannala"),
    "width a float": (camera(width=120.0), "camera.width: expected a whole number"),
    "width huge": (camera(width=10**9), "camera.width: expected a whole number in 2 to 32768"),
    "width true": (camera(width=True), "camera.width: expected a whole number"),
    "height zero": (camera(height=0), "camera.height: expected a whole number"),
    "fx negative": (camera(fx=-100.0), "camera.fx: expected a number in 1 to 1e\\+06"),
    "fy zero": (camera(fy=0), "camera.fy: expected a number in 1 to"),
    "fx a text": (camera(fx="wide"), "camera.fx: expected a number, found 'wide'"),
    "cx NaN": (camera(cx=float("nan")), "camera.cx: expected a finite number"),
    "cy infinite": (camera(cy=float("inf")), "camera.cy: expected a finite number"),
    "three coefficients": (
        camera(distortion=[0.1, 0.1, 0.1]),
        "camera.distortion: expected 0, 4, 5, 8, 12, 14 numbers for brown_conrady, found 3",
    ),
    "fisheye without": (
        camera(model="kannala_brandt", distortion=[]),
        "camera.distortion: expected 4 numbers for kannala_brandt, found 0",
    ),
    "coefficient NaN": (
        camera(distortion=[0.1, float("nan"), 0, 0]),
        r"camera.distortion\[1\]: expected a finite number",
    ),
    "distortion no list": (camera(distortion=0.0), "camera.distortion: expected a list of numbers"),
    "does not close": (
        camera(distortion=[-1.5, 0.0, 0.0, 0.0]),
        "camera.distortion: undistortion closes on [0-9]+% of the image; expected 90% or more",
    ),
    "normal length": (road(normal=[0, 1.002, 0]), "road.normal: expected a unit vector, found one"),
    "normal short": (road(normal=[0, 1]), "road.normal: expected a list of 3 numbers, found 2 val"),
    "height_m": (road(height_m=-1.45), "road.height_m: expected a number in 0.01 to"),
    "mount no mapping": (lambda t: t.rigs["a"].update(mount="rig.urdf"), "mount: expected a mapp"),
    "urdf missing": (mount(urdf="other.urdf"), "other.urdf: the file is missing"),
    "urdf outside": (
        mount(urdf="../b/rig.urdf"),
        "mount.urdf: expected a file inside the rig's fol",
    ),
    "urdf absolute": (mount(urdf="/etc/hostname"), "mount.urdf: expected a file inside the rig's"),
    "link unknown": (mount(camera_link="nose"), "rig.urdf: .*no link 'nose'"),
    "joint moves": (urdf('type="fixed"', 'type="continuous"'), "rig.urdf: .*expected 'fixed'"),
    "urdf NaN": (urdf("1.5 0.1", "nan 0.1"), "rig.urdf: .*not finite"),
    "urdf no xml": (lambda t: t.urdfs.update(a="<robot"), "rig.urdf: URDF cannot be read"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_rig_is_one_line(sound, fault) -> None:
    spoil, reason = FAULTS[fault]
    spoil(sound)
    folder = sound.write() / "rigs" / "a"
    folder.mkdir(parents=True, exist_ok=True)
    with pytest.raises(InputError, match=reason) as error:
        read_rig(folder)
    assert "\n" not in str(error.value)


def test_a_link_out_of_the_rigs_folder_is_not_followed(sound) -> None:
    sound.urdfs["b"] = sound.urdfs.pop("a")
    folder = sound.write() / "rigs" / "a"
    (folder / "rig.urdf").symlink_to(folder.parent / "b" / "rig.urdf")
    with pytest.raises(InputError, match="expected a file inside the rig's folder"):
        read_rig(folder)


def test_a_rig_that_is_not_text_is_refused(sound) -> None:
    folder = sound.write() / "rigs" / "a"
    (folder / "rig.yaml").write_bytes(b"camera: \xff\xfe")
    with pytest.raises(InputError, match=r"rig\.yaml: is no UTF-8 text"):
        read_rig(folder)


def test_a_missing_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the rig's folder is missing"):
        read_rig(tmp_path / "nobody")
