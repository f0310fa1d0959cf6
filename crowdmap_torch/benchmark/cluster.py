"""Signs of a thousand journeys told apart: ours beside scikit-learn's SpectralClustering and HDBSCAN.

Ours gets the triangulations as measured and finds the journeys' biases by itself. The others know nothing of journeys:
they get the places with the true biases taken off, and SpectralClustering the true number of signs as well. What
HDBSCAN makes of the places as measured is shown too.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from sklearn.cluster import HDBSCAN, SpectralClustering
from torch import Tensor

from crowdmap_torch.clustering.groups import pairs_within
from crowdmap_torch.crowd_signs.gather import CrowdSigns
from crowdmap_torch.crowd_signs.register import CrowdConfig, register_crowd
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.processes.workers import Workers
from crowdmap_torch.ranges import Count, Rounds, argument
from crowdmap_torch.tables import Signs

THREADS = 2
SIGNS = 100
"""Signs along the street; every journey drives by them all."""
_MISSED = 0.1
_POST_M = 40.0
_VIEW_M = 12.0
"""Where a sign is seen from nearest."""


@dataclass(frozen=True)
class Street:
    """Triangulations of many biased journeys along one street, with the truth."""

    crowd: CrowdSigns
    sign: Int[Tensor, " n"]
    """True sign of each triangulation."""
    error: Float[Tensor, "n 3"]
    """True pose error behind each [m]."""


def make_street(triangulations: int, *, seed: int) -> Street:
    """About so many triangulations: half of the posts carry two signs, 0.7 m apart; biases 0.85 m, slow drift."""
    g = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=g, dtype=torch.float64)

    journeys = max(round(triangulations / (SIGNS * (1 - _MISSED))), 2)
    post = torch.arange(SIGNS) * 2 // 3  # two on every other post
    level = torch.cat((torch.zeros(1), (post[1:] == post[:-1]).double()))
    center = torch.stack((_POST_M * post, -5.0 + 0 * level, 2.3 + 0.7 * level), dim=1).double()
    shape = torch.randint(len(polygon.SHAPES), (SIGNS,), generator=g)
    journey, sign = torch.cartesian_prod(torch.arange(journeys), torch.arange(SIGNS)).T
    seen = torch.rand(len(sign), generator=g) > _MISSED
    journey, sign = journey[seen], sign[seen]
    n = len(sign)
    # The drift: two waves of a few hundred metres for each journey and axis.
    phase = center[sign, 0, None] * (0.01 + 0.01 * torch.rand(journeys, 3, generator=g)[journey])
    phase = phase + 6.3 * torch.rand(journeys, 3, generator=g)[journey]
    bias_sigma = torch.tensor([0.85, 0.85, 1.2], dtype=torch.float64)
    error = (normal(journeys, 3) * bias_sigma)[journey] + 0.25 * phase.double().sin()
    sigma = torch.tensor([0.2, 0.05, 0.05], dtype=torch.float64)
    measured = center[sign] + error + sigma * normal(n, 3)
    yaw = 0.06 * normal(n)
    normals = torch.stack((-yaw.cos(), -yaw.sin(), 0 * yaw), dim=1)
    up = torch.eye(3, dtype=torch.float64)[2].expand(n, 3)
    R = torch.stack((torch.linalg.cross(up, normals), up, normals), dim=2)
    one = torch.ones(n, dtype=torch.int64)
    signs = Signs(
        shape=shape[sign],
        type=torch.full_like(one, -1),
        T_world_sign=se3.make(R, measured),
        size=0.7 * (1 + 0.05 * normal(n, 2)),
        covariance=torch.diag(sigma.square()).expand(n, 3, 3),
        journey=journey,
        tracklet=torch.arange(n),
        frame=0 * one,
        n_journeys=one,
        n_observations=20 * one,
        first_seen_ns=0 * one,
        last_seen_ns=one,
        confidence=torch.ones(n, dtype=torch.float64),
    )
    view = measured - torch.tensor([_VIEW_M, -3.5, 1.0])
    east = torch.eye(3, dtype=torch.float64)[0]
    way = torch.arange(0, float(center[-1, 0]), 4.0, dtype=torch.float64)
    path = way[None, :, None] * east + (normal(journeys, 3) * bias_sigma)[:, None]
    crowd = CrowdSigns(
        signs=signs,
        station=center[sign, 0],
        view_position=view,
        view_direction=east.expand(n, 3),
        # Signs of one post are seen in the same frames.
        seen_together=pairs_within(journey * SIGNS + post[sign]),
        leap=torch.zeros(journeys, dtype=torch.float64),
        bias_sigma=bias_sigma.expand(journeys, 3),
        path_journey=torch.arange(journeys).repeat_interleave(len(way)),
        path_position=path.reshape(-1, 3),
        path_direction=east.expand(journeys * len(way), 3),
    )
    return Street(crowd, sign, error)


def ours(street: Street) -> Int[Tensor, " n"]:
    """Clusters and biases found together."""
    return register_crowd(street.crowd, PositioningNoise(), CrowdConfig()).label


def spectral(street: Street) -> Int[Tensor, " n"]:
    """Spectral clustering of each place's nearest neighbours into the true number of signs."""
    neighbours = min(48, max(street.crowd.journeys - 1, 2))
    found = SpectralClustering(
        SIGNS, affinity="nearest_neighbors", n_neighbors=neighbours, random_state=0
    )
    return torch.from_numpy(found.fit_predict(_true_places(street))).long()


def hdbscan(street: Street) -> Int[Tensor, " n"]:
    """Clusters of at least three places, of any density."""
    return torch.from_numpy(_HDBSCAN.fit_predict(_true_places(street))).long()


def hdbscan_as_measured(street: Street) -> Int[Tensor, " n"]:
    """The same of the places that ours gets."""
    places = street.crowd.signs.center_world.numpy()
    return torch.from_numpy(_HDBSCAN.fit_predict(places)).long()


def _true_places(street: Street) -> Float[np.ndarray, "n 3"]:
    return (street.crowd.signs.center_world - street.error).numpy()


_HDBSCAN_OPTIONS: dict[str, Any] = {"min_cluster_size": 3, "copy": True}
_HDBSCAN = HDBSCAN(**_HDBSCAN_OPTIONS)


METHODS: dict[str, Callable[[Street], Int[Tensor, " n"]]] = {
    "crowdmap_torch": ours,
    "SpectralClustering": spectral,
    "HDBSCAN": hdbscan,
    "HDBSCAN, measured": hdbscan_as_measured,
}


@dataclass(frozen=True)
class Measured:
    """One run of one method."""

    seconds: float
    peak_mb: float
    """Most memory of its process."""
    precision: float
    """Of pairs of triangulations in one cluster, the share that are one sign."""
    recall: float


def measure(method: str, triangulations: int, seed: int) -> Measured:
    """Times a method in the process that calls this."""
    torch.set_num_threads(THREADS)
    street = make_street(triangulations, seed=seed)
    begun = time.perf_counter()
    label = METHODS[method](street)
    seconds = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Measured(seconds, peak, *pair_scores(street.sign, label))


def pair_scores(sign: Int[Tensor, " n"], label: Int[Tensor, " n"]) -> tuple[float, float]:
    """Precision and recall of pairs of rows that are one sign being in one cluster; -1 is no cluster."""
    used = label >= 0
    both = _pairs(sign[used] * (int(label.max()) + 2) + label[used])
    return both / max(_pairs(label[used]), 1), both / max(_pairs(sign), 1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """How many triangulations, and how often."""
    parser.add_argument("--sizes", type=argument(Count), nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument(
        "--repeats", type=argument(Rounds), default=3, help="runs of each; the median counts"
    )
    parser.add_argument(
        "--spectral-limit",
        type=int,
        default=10_000,
        metavar="N",
        help="most triangulations given to SpectralClustering",
    )


def run(options: argparse.Namespace) -> None:
    """Prints medians of all methods on all sizes, each run in a fresh process, methods in turn."""
    print(
        f"{'triangulations':>14} {'method':>18} {'s':>8} {'MB':>7} {'precision':>10} {'recall':>8}"
    )
    for size in options.sizes:
        methods = [
            m for m in METHODS if m != "SpectralClustering" or size <= options.spectral_limit
        ]
        runs: dict[str, list[Measured]] = {method: [] for method in methods}
        for seed in range(options.repeats):
            for method in methods:
                runs[method].append(_in_fresh_process(method, size, seed))
        for method, found in runs.items():
            middle = [
                statistics.median(getattr(one, name) for one in found)
                for name in ("seconds", "peak_mb", "precision", "recall")
            ]
            seconds, peak, precision, recall = middle
            print(
                f"{size:14d} {method:>18} {seconds:8.2f} {peak:7.0f} {precision:10.4f} {recall:8.4f}",
                flush=True,
            )


def _in_fresh_process(method: str, triangulations: int, seed: int) -> Measured:
    # Read when the libraries are loaded, that is, by the child.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(THREADS)
    with Workers(1, torch.set_num_threads, THREADS) as pool:
        pool.start(method, (method, measure, (method, triangulations, seed)))
        return pool.wait()[0][1]


def _pairs(group: Int[Tensor, " n"]) -> int:
    _, count = group.unique(return_counts=True)
    return int((count * (count - 1)).sum()) // 2
