"""XML files of others, without entities: they may unfold without end, or name other files."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from crowdmap_torch.io.budget import read_bytes
from crowdmap_torch.io.errors import InputError, one_line


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file; InputError if it is none, or has a DOCTYPE."""
    content = read_bytes(path)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise InputError(f"{path}: has a DOCTYPE or entities; expected neither")
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as XML ({one_line(error)})") from error
