from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import pytest
import torch
from matplotlib._pylab_helpers import Gcf
from matplotlib.quiver import Quiver

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.signs import compare_signs
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report import plots
from crowdmap_torch.report.plots import Eigengap, sign_errors
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.tables import Dataset, Survey


def over_image() -> tuple[torch.Tensor, torch.Tensor]:
    """Corners all over an image of 1280 x 720, the residuals of a lens whose distortion is wrong, an outlier and a NaN."""
    px = torch.rand(4000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    px = px * px.new_tensor([1280, 720])
    away = (px - px.new_tensor([640, 360])) / 640
    residual = 3 * away * away.norm(dim=1, keepdim=True) ** 2
    residual[0], residual[1] = 1000, torch.nan
    return px, residual


def every_plot(record: RunRecord):
    return [
        plots.plot_map(record.hd_map, record.survey),
        plots.plot_eigengaps(record.spectra),
        plots.plot_residuals(record.residual_px),
        plots.plot_residuals_over_image(*over_image(), (1280, 720)),
    ]


def test_every_plot_can_be_an_svg_and_an_image(record):
    for figure in every_plot(record):
        assert plots.svg(figure).startswith("<svg")
        image = plots.pixels(figure)
        assert image.ndim == 3
        assert image.shape[2] == 3
        assert image.std() > 0


def test_a_figure_that_is_drawn_again_looks_the_same(record):
    for figure in every_plot(record):
        first = plots.svg(figure)
        places = [axes.get_position().bounds for axes in figure.axes]
        plots.pixels(figure)
        assert [axes.get_position().bounds for axes in figure.axes] == places
        assert len(plots.svg(figure)) == len(first)


def test_a_map_and_drives_are_plotted_and_nothing_else(record: RunRecord, tiny: Dataset):
    (axes,) = plots.plot(record.hd_map, record.survey).axes
    assert axes.get_legend_handles_labels()[1] == ["survey", "map"]
    (axes,) = plots.plot(tiny).axes
    assert [line.get_label() for line in axes.lines] == [j.journey_id for j in tiny.journeys]
    with pytest.raises(TypeError):
        plots.plot("map")  # pyright: ignore[reportArgumentType]


def test_arrows_over_the_image_are_medians_where_corners_were_seen():
    px, residual = over_image()
    axes = plots.plot_residuals_over_image(px, residual, (1280, 720)).axes[0]
    arrows = next(c for c in axes.collections if isinstance(c, Quiver))
    middle = torch.as_tensor(arrows.get_offsets())
    found = torch.stack([torch.as_tensor(x) for x in (arrows.U, arrows.V)], dim=1)
    # The distortion at the middle of each cell of 53 px, across which it changes by 0.9 px at most.
    away = (middle - middle.new_tensor([640, 360])) / 640
    expected = 3 * away * away.norm(dim=1, keepdim=True) ** 2
    assert len(middle) > 250
    assert (found - expected).abs().max() < 0.5


def test_drawing_leaves_no_global_state(record):
    before = dict(mpl.rcParams)
    every_plot(record)
    assert dict(mpl.rcParams) == before
    assert Gcf.get_all_fig_managers() == []


@pytest.mark.parametrize("residual", [torch.zeros(0), torch.full((3,), torch.nan), torch.zeros(5)])
def test_nothing_to_draw_is_drawn(build, record, residual):
    both = residual[:, None].expand(-1, 2)
    nothing = build.hd_map(build.signs(torch.zeros(0, 3, dtype=torch.float64)))
    figures = [
        plots.plot_map(nothing),
        plots.plot_residuals({"a": residual}),
        plots.plot_residuals_over_image(both, both, (8, 6)),
        plots.plot_eigengaps([Eigengap("one", (0.0,), 1), Eigengap("none", (), 0)]),
    ]
    for figure in figures:
        assert plots.svg(figure)


def test_errors_are_of_centres_where_no_corners_were_surveyed(build):
    true = build.signs([[0.0, 0, 2], [40, 0, 2], [80, 0, 2]])
    survey = build.survey_signs(true)
    one_center = survey.corners_world.clone()
    one_center[1] = torch.nan
    comparison = compare_signs(
        build.moved(true, (0.3, 0, 0)), replace(survey, corners_world=one_center)
    )
    assert plots.sign_errors(comparison, "absolute").tolist() == pytest.approx([0.3] * 3)
    assert plots.sign_errors(comparison, "relative").max() < 1e-9


def test_the_report_shows_the_signs_that_the_figures_count(
    tiny_result: MapResult, tiny_survey: Survey, tiny_truth: Truth
):
    control = tiny_survey.sign_id[:2]
    figures = evaluate_map(tiny_result.hd_map, tiny_survey, truth=tiny_truth, control_ids=control)
    assert figures.comparison is not None
    assert "comparison" not in figures.as_dict()
    errors = sign_errors(figures.comparison, "absolute")
    assert len(errors) == figures.signs.matched_observable < len(tiny_survey.sign_id)
    assert float(errors.mean()) == pytest.approx(figures.signs.absolute.total.mean, rel=0.1)
