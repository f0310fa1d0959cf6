"""What was found of the cars' calibrations, as a figure and a table of report.html."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.report.plots import FAINT, MAP, new_figure, styled
from crowdmap_torch.report.tables_html import simple_table

_MOST_CARS = 12
"""Cars that the figure shows."""
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


@styled
def plot_calibration(found: FleetCalibration) -> Figure:
    """Every number of every car in units of its prior sigma, with its own 95 % interval; grey the prior's."""
    names = [name for car in found.values() for name in car.estimate]
    names = list(dict.fromkeys(names))
    figure, panels = new_figure(max(len(names), 1), width=max(1.5 * len(names), 4.0), height=3.2)
    cars = list(found.items())[:_MOST_CARS]
    for axes, name in zip(panels, names, strict=False):
        axes.axvspan(-1.96, 1.96, color=FAINT, alpha=0.3, lw=0)
        axes.axvline(0, color=FAINT, lw=0.8)
        for row, (_, car) in enumerate(cars):
            prior = np.array(car.prior_sigma[name])
            value, sigma = np.array(car.estimate[name]) / prior, np.array(car.sigma[name]) / prior
            place = row + 0.22 * (np.arange(len(value)) - (len(value) - 1) / 2)
            axes.errorbar(value, place, xerr=1.96 * sigma, fmt=".", color=MAP, ms=5, lw=1)
        axes.set(title=name, yticks=range(len(cars)), ylim=(len(cars) - 0.5, -0.5))
        axes.set_yticklabels([key for key, _ in cars] if axes is panels[0] else [])
    panels[0].set(xlabel="in sigmas of the prior")
    return figure


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
