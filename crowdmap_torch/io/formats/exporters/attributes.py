"""Elements of XML with numbers to the last digit, and cubics as OpenDRIVE has them."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from jaxtyping import Float


def add_cubics(parent: ET.Element, name: str, s: str, rows: Float[np.ndarray, "_ 5"]) -> None:
    """Children with a cubic each, where it begins being attribute `s`."""
    for row in rows.tolist():
        add(parent, name, **dict(zip((s, *"abcd"), row, strict=True)))


def add(parent: ET.Element, tag: str, /, **attributes: object) -> ET.Element:
    """A child with attributes; numbers to the last digit."""
    texts = {
        key: repr(float(value)) if isinstance(value, float | np.floating) else str(value)
        for key, value in attributes.items()
    }
    return ET.SubElement(parent, tag, texts)
