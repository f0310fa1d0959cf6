from __future__ import annotations

import pytest
import torch
from worlds.small_world import Builder

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.report.drives import CornerResiduals, Drift
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.plots import Eigengap
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.summaries import JourneySummary, OutageSummary, Pruned
from crowdmap_torch.tables import RejectedJourney
from crowdmap_torch.viewer.scene import Drive


@pytest.fixture(scope="session")
def record(build: Builder) -> RunRecord:
    """A run with something in every part of the report."""
    k = torch.arange(9, dtype=torch.float64)
    true = build.signs(
        torch.stack((12 * k, 4 * (-1) ** k, 2 + 0.1 * k), dim=-1), shape=k.long() % 6
    )
    lines = [build.straight(y) for y in (0.0, 3.5)]
    survey = build.survey(true, lines)
    generator = torch.Generator().manual_seed(3)

    def noisy(sigma: float):
        noise = sigma * torch.randn(9, 3, generator=generator, dtype=torch.float64)
        return build.hd_map(build.moved(true, noise), build.lanes(lines), shared=0.05)

    hd_map, before = noisy(0.05), noisy(0.2)
    iterations = tuple(
        Iteration(
            number=n,
            cost={"sign_reprojection": 100.0 / (n + 1), "pose_absolute": 3.0 + n},
            damping=1e-4,
            gain_ratio=0.9,
            step_norm=1.0 / (n + 1),
            cost_before=120.0 / (n + 1) if n else float("nan"),
            scale={"sign_px": 2.0 if n < 2 else 1.0, "lane_correlation": 0.1},
            judged=int(n > 3),
            errors={"error/corner_m": 0.2 / (n + 1)},
        )
        for n in range(5)
    )
    return RunRecord(
        title="a street <of> tests",
        facts={"with": "version & date"},
        hd_map=hd_map,
        map_before=before,
        survey=survey,
        figures=evaluate_map(hd_map, survey),
        figures_before=evaluate_map(before, survey),
        drives=tuple(
            Drive(name, torch.arange(11), torch.arange(11) * 10**8, build.straight(y))
            for name, y in (("a", 1.5), ("b", 1.8))
        ),
        journeys=(
            JourneySummary(
                "a",
                frames=100,
                detections=50,
                used=48,
                signs=9,
                bias=(0.3, -0.2, 0.5),
                bias_sigma=(0.12, 0.13, 0.14),
                heading_deg=0.1,
                heading_sigma_deg=0.011,
                true_bias=(0.31, -0.2, 0.4),
            ),
            JourneySummary("b", 90, 40, 40, 9, (-0.3, 0.2, -0.5)),
        ),
        counts={"sign detections": 90, "eigenvalue gap": 0.61, "method": "ours"},
        pruned=(Pruned("signs", "too little parallax", 3), Pruned("signs", "too short", 12)),
        rejected=(RejectedJourney("c", "poses.parquet: row 3: x is NaN"),),
        outlier_journeys=(RejectedJourney("d", "its bias of 9.8 m does not fit the others"),),
        outages=(OutageSummary("a", 120.0, 310.4, 2.75),),
        spectra=(Eigengap("signs, round 2", (0.0, 0.01, 0.02, 0.7, 0.8), 3),),
        residual_px={"triangulated": torch.rand(200, generator=generator) + 0.1},
        corners=CornerResiduals(
            journey=torch.arange(200) % 2,
            residual_px=torch.randn(200, 2, generator=generator, dtype=torch.float64),
            place=torch.rand(200, 2, generator=generator, dtype=torch.float64) * 0.1,
            range_m=10 + 40 * torch.rand(200, generator=generator, dtype=torch.float64),
        ),
        drifts=(Drift("a", (0.0, 50.0, 100.0), (0.1, 0.0, -0.1), (0.0,) * 3, (-0.2, 0.1, 0.1)),),
        iterations=iterations,
        outcome="converged: the cost no longer falls",
        timings_s={"read": 1.0, "adjust": 4.0},
        config_yaml="clustering:\n  sign_scales_m: [4.0, 1.0]\n",
    )
