"""The shape of an OpenDRIVE road: its reference line, its elevation and how it tilts."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.attributes import add, add_cubics
from crowdmap_torch.io.formats.exporters.reference_line import ReferenceLine, cubics


def add_shape(
    element: ET.Element,
    line: ReferenceLine,
    tilt: Float[np.ndarray, " knots"],
    tilt_slope: Float[np.ndarray, " knots"],
) -> None:
    """Adds plan view, elevation and superelevation to a road: `tilt` [rad] and its change with s at the line's knots."""
    plan = ET.SubElement(element, "planView")
    for k, c in enumerate(line.coefficient):
        geometry = add(
            plan,
            "geometry",
            s=line.s[k],
            x=line.start[k, 0],
            y=line.start[k, 1],
            hdg=line.heading[k],
            length=line.s[k + 1] - line.s[k],
        )
        powers = {
            f"{a}{axis}": c[p, j] for j, axis in enumerate("UV") for p, a in enumerate("abcd")
        }
        add(geometry, "paramPoly3", **powers, pRange="arcLength")
    profile = ET.SubElement(element, "elevationProfile")
    add_cubics(profile, "elevation", "s", cubics(line.s, line.height, line.slope))
    lateral = ET.SubElement(element, "lateralProfile")
    add_cubics(lateral, "superelevation", "s", cubics(line.s, tilt, tilt_slope))
