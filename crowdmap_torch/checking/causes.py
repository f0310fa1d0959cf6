"""What a fault of a file mostly comes from, and what to do about it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from crowdmap_torch.io.faults import Fault
from crowdmap_torch.plausibility.finding import Repair


@dataclass(frozen=True)
class _Cause:
    pattern: str
    kind: str
    cause: str
    cure: str
    repair: Repair | None = None


_CAUSES = (
    _Cause(
        r"column '(\w+)' has type",
        "column-type",
        "the writer chose another type",
        "write the type that is expected",
        Repair("column-type"),
    ),
    _Cause(
        r"column '\w+' is missing",
        "missing-column",
        "the writer calls it otherwise, or leaves it out",
        "name columns as FORMAT.md does",
    ),
    _Cause(
        r"is null; expected",
        "null",
        "what was not known was left empty",
        "fill it in, or leave such rows out",
    ),
    _Cause(
        r"expected a? ?finite numbers?",
        "not-finite",
        "what was not known was written as NaN or infinity",
        "fill it in, or leave such rows out; in optional columns write null",
    ),
    _Cause(
        r"strictly increasing",
        "order",
        "rows are out of order, or a frame is there twice",
        "sort the file by frame, and write each frame once",
    ),
    _Cause(
        r"quaternion .* has length",
        "quaternion-length",
        "columns are in another order, or hold no quaternion",
        "write unit quaternions qx qy qz qw",
    ),
    _Cause(
        r"the car moves",
        "leap",
        "positioning lost its way, or two drives stand in one file",
        "cut the journey there",
    ),
    _Cause(
        r"from the origin; expected metres",
        "far-away",
        "positions are UTM or earth-centred coordinates, or a row is broken",
        "write metres east, north and up of dataset.json's origin",
    ),
    _Cause(
        r"is not in poses\.parquet",
        "unknown-frame",
        "detections are numbered otherwise than poses, or poses are missing",
        "number detections by the rows of poses.parquet's column frame",
    ),
    _Cause(
        r"is unknown; expected one of",
        "unknown-name",
        "another list of names was used, or other letters",
        "write a name of the list, in small letters",
    ),
    _Cause(
        r"(corners|points); expected|values in u and",
        "point-count",
        "the shape is another, or a point was lost",
        "write as many points as the shape has, as many u as v",
    ),
    _Cause(r"expected 0 to 1", "score", "scores are percentages or logits", "write 0 to 1"),
    _Cause(
        r"undistortion closes",
        "lens",
        "coefficients are in another order, or of another image size",
        "write k1, k2, p1, p2, k3 (OpenCV's order), fx, fy, cx, cy in pixels of these images",
    ),
    _Cause(
        r"(is missing|is there instead|link)",
        "missing",
        "a file was not written, or has another name",
        "write it (with no rows if there is nothing to say)",
    ),
    _Cause(
        r"cannot be read|no UTF-8",
        "unreadable",
        "the file is broken, or of another kind",
        "write it anew",
    ),
    _Cause(
        r"not clockwise", "dropped", "corners of this outline run the other way", "turn them round"
    ),
    _Cause(
        r"outside the image",
        "dropped",
        "the object is cut off by the border, or the image has another size",
        "leave it out, or clip it",
    ),
    _Cause(
        r"(sign|lane|lane point): ", "dropped", "the detector slipped", "nothing, if they are few"
    ),
)
_OTHER = _Cause("", "format", "the file does not follow FORMAT.md", "write what is expected")


def explanation(fault: Fault) -> tuple[str, str, str, Repair | None]:
    """The likely cause of a fault, its cure, what it is called, and what puts it right if that is one thing."""
    for known in _CAUSES:
        if found := re.search(known.pattern, fault.rule):
            repair = known.repair
            if repair is not None:
                repair = Repair(repair.name, of=found.group(1))
            return known.cause, known.cure, known.kind, repair
    return _OTHER.cause, _OTHER.cure, _OTHER.kind, None
