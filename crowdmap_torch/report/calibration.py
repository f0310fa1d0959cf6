"""What was found of the cars' calibrations, as a table of report.html."""

from __future__ import annotations

from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.report.tables_html import simple_table

_TEXT = {
    "mount_deg": "mount, turn [deg]",
    "mount_m": "mount, place [m]",
    "clock_s": "clock [s]",
    "focal": "focal length, share",
    "principal_px": "principal point [px]",
    "read_out_s": "read-out [s]",
    "box": "outline of signs, share",
    "corner_px": "corners [px]",
    "lane_m": "lane points to the left [m]",
    "height_m": "camera height [m]",
}


def calibration_table(found: FleetCalibration) -> str:
    """One row a car and parameter: what was found, how sure, and what could not be seen."""
    rows = []
    for car, numbers in found.items():
        for name, estimate in numbers.estimate.items():
            told = ", ".join(
                f"{value:+.4g} \u00b1 {sigma:.2g}"
                for value, sigma in zip(estimate, numbers.sigma[name], strict=True)
            )
            ratio = ", ".join(f"{r:.2f}" for r in numbers.ratio(name))
            unseen = [label for label in numbers.unseen if label.split(" ")[0] == name]
            mixed = [
                f"{a} with {b}"
                for a, b, _ in numbers.confounded
                if name in (a.split(" ")[0], b.split(" ")[0])
            ]
            rows.append((car, _TEXT[name], told, ratio, "; ".join(unseen), "; ".join(mixed)))
    head = (
        "car",
        "truth minus rig.yaml",
        "found",
        "sigma over prior",
        "not seen",
        "not told apart",
    )
    return simple_table(head, rows)
