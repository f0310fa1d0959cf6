"""The benchmark of clustering measures what it says."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.benchmark import cluster
from crowdmap_torch.cli import main


def test_the_street_is_as_large_and_as_biased_as_it_says():
    street = cluster.make_street(2000, seed=0)
    assert len(street.sign) == pytest.approx(2000, rel=0.05)
    left = street.crowd.signs.center_world - street.error
    for sign in (0, 1, 40):
        spread = left[street.sign == sign].std(0)
        assert (spread < 0.35).all() and spread[0] > 0.1
    assert street.error.std() > 0.7


def test_all_methods_solve_a_small_street():
    street = cluster.make_street(1500, seed=1)
    for method in ("crowdmap_torch", "SpectralClustering"):
        precision, recall = cluster.pair_scores(street.sign, cluster.METHODS[method](street))
        assert precision > 0.9 and recall > 0.9, method


def test_pair_scores_of_a_known_case():
    sign = torch.tensor([0, 0, 0, 1, 1, 2])
    label = torch.tensor([0, 0, -1, 0, 1, 2])
    # In one cluster: three pairs, one of them true. True pairs: three and one.
    assert cluster.pair_scores(sign, label) == (1 / 3, 1 / 4)


def test_the_table_has_a_line_for_each_method(capsys: pytest.CaptureFixture[str]):
    few = ["--sizes", "300", "--repeats", "1", "--spectral-limit", "100"]
    assert main(["benchmark", "cluster", *few]) == 0
    lines = capsys.readouterr().out.splitlines()
    methods = ["crowdmap_torch", "HDBSCAN", "HDBSCAN, measured"]
    assert all(method in line for method, line in zip(methods, lines[1:], strict=True))
