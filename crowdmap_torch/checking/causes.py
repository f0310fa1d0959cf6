"""What a fault of a file mostly comes from, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

from crowdmap_torch.io.errors import Code
from crowdmap_torch.io.faults import Fault
from crowdmap_torch.plausibility.finding import Repair


@dataclass(frozen=True)
class Explanation:
    """The likely cause of faults of a kind, and its cure."""

    kind: str
    """What a finding about them is called."""
    cause: str
    cure: str


_WHERE_UNKNOWN = "fill it in, or leave such rows out"
_COLUMNS = "the writer calls it otherwise, or leaves it out"
_AS_EXPECTED = "write what is expected"
_OTHER = Explanation("format", "the file does not follow FORMAT.md", _AS_EXPECTED)
_SLIPPED = Explanation("dropped", "the detector slipped", "nothing, if they are few")

EXPLANATIONS: dict[Code, Explanation] = {
    "other": _OTHER,
    "missing-file": Explanation(
        "missing",
        "a file was not written, or has another name",
        "write it (with no rows if there is nothing to say)",
    ),
    "unreadable": Explanation(
        "unreadable", "the file is broken, or of another kind", "write it anew"
    ),
    "too-large": _OTHER,
    "other-version": Explanation(
        "format", "the file is of another kind, or of another version", "write it anew"
    ),
    "missing-key": Explanation("missing-key", _COLUMNS, "name keys as FORMAT.md does"),
    "unknown-key": Explanation(
        "unknown-key",
        "a slip of the pen, or a key of another program",
        "leave it out, or correct it",
    ),
    "value": _OTHER,
    "range": _OTHER,
    "lens": Explanation(
        "lens",
        "coefficients are in another order, or of another image size",
        "write k1, k2, p1, p2, k3 (OpenCV's order), fx, fy, cx, cy in pixels of these images",
    ),
    "missing-column": Explanation("missing-column", _COLUMNS, "name columns as FORMAT.md does"),
    "column-type": Explanation(
        "column-type", "the writer chose another type", "write the type that is expected"
    ),
    "null": Explanation("null", "what was not known was left empty", _WHERE_UNKNOWN),
    "not-finite": Explanation(
        "not-finite",
        "what was not known was written as NaN or infinity",
        f"{_WHERE_UNKNOWN}; in optional columns write null",
    ),
    "unknown-name": Explanation(
        "unknown-name",
        "another list of names was used, or other letters",
        "write a name of the list, in small letters",
    ),
    "name-twice": _OTHER,
    "no-rows": _OTHER,
    "order": Explanation(
        "order",
        "rows are out of order, or a frame is there twice",
        "sort the file by frame, and write each frame once",
    ),
    "far-away": Explanation(
        "far-away",
        "positions are UTM or earth-centred coordinates, or a row is broken",
        "write metres east, north and up of dataset.json's origin",
    ),
    "leap": Explanation(
        "leap", "positioning lost its way, or two drives stand in one file", "cut the journey there"
    ),
    "quaternion-length": Explanation(
        "quaternion-length",
        "columns are in another order, or hold no quaternion",
        "write unit quaternions qx qy qz qw",
    ),
    "unknown-frame": Explanation(
        "unknown-frame",
        "detections are numbered otherwise than poses, or poses are missing",
        "number detections by the rows of poses.parquet's column frame",
    ),
    "point-count": Explanation(
        "point-count",
        "the shape is another, or a point was lost",
        "write as many points as the shape has, as many u as v",
    ),
    "score": Explanation("score", "scores are percentages or logits", "write 0 to 1"),
    "outside-image": Explanation(
        "dropped",
        "the object is cut off by the border, or the image has another size",
        "leave it out, or clip it",
    ),
    "not-clockwise": Explanation(
        "dropped", "corners of this outline run the other way", "turn them round"
    ),
    "crosses-itself": _SLIPPED,
    "no-area": _SLIPPED,
    "off-axis": _SLIPPED,
    "no-ray": _SLIPPED,
    "few-points": _SLIPPED,
    "no-length": _SLIPPED,
    "copy": Explanation("copy", "one drive was uploaded more than once", "leave the copy out"),
}
"""By the code of a fault."""


def repair_of(fault: Fault) -> Repair | None:
    """What puts a fault of a file right, if it is one thing."""
    return Repair("column-type", of=fault.column) if fault.code == "column-type" else None
