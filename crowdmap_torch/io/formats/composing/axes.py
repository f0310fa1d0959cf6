"""Conventions of axes that trajectories come in, and the turns that bring them to FORMAT.md's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

WORLDS = {
    "enu": np.eye(3),
    "ned": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "rdf": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""R_enu_world of each."""
WORLD_TEXTS = {
    "enu": "x east, y north, z up",
    "ned": "x north, y east, z down",
    "rdf": "x right, y down, z forward of the first camera, where forward counts as north",
}
LINKS = {
    "camera": np.eye(3),
    "flu": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "frd": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "rub": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
}
"""R_link_camera of a camera that looks straight ahead."""
LINK_TEXTS = {
    "camera": "the camera's own: x right, y down, z forward",
    "flu": "a body's: x forward, y left, z up",
    "frd": "a body's: x forward, y right, z down",
    "rub": "an OpenGL camera's: x right, y up, z backward",
    "mount": "of the link that the rig's mount names",
}


def turned_world(
    T_world_link: Float[np.ndarray, "n 4 4"], world: str
) -> Float[np.ndarray, "n 4 4"]:
    """The same poses in East-North-Up."""
    T_enu_world = np.eye(4)
    T_enu_world[:3, :3] = WORLDS[world]
    return T_enu_world @ T_world_link


def link_camera(link: str, camera_at: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """T_link_camera of a camera that looks straight ahead from a place of the link [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = LINKS[link], camera_at
    return T
