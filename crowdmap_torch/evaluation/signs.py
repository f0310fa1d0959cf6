"""Signs of a map against those of a survey (METRICS.md, Signs)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.clustering.neighbours import pairs_between
from crowdmap_torch.evaluation.statistics import (
    ErrorFigures,
    PositionFigures,
    error_figures,
    mean_lengths,
    position_figures,
    share,
)
from crowdmap_torch.geometry import polygon
from crowdmap_torch.ranges import Count, Length, Settings
from crowdmap_torch.survey.matching import (
    DUPLICATE,
    FALSE,
    SurveyMatch,
    SurveyMatchConfig,
    match_to_survey,
)
from crowdmap_torch.tables import Signs, SurveySigns


@dataclass(frozen=True)
class SignEvaluationConfig(Settings):
    """How signs are matched and which neighbours the relative error looks at."""

    match: SurveyMatchConfig = field(default_factory=SurveyMatchConfig)
    relative_radius_m: Length = 150.0
    """Matched signs within this distance are brought onto the truth together."""
    relative_min_signs: Count = 3
    """Fewer signs in that circle, its own centre counted, and the sign has no relative error."""
    close_pair_m: Length = 1.0
    """True signs this near to each other stand on one post."""


@dataclass(frozen=True)
class SignComparison:
    """Every matched sign beside its true one, control signs left out."""

    match: SurveyMatch
    """Before control signs are left out."""
    map_row: Tensor
    true_row: Tensor
    counted: Bool[Tensor, " k"]
    """True where the true sign is observable."""
    center_error_world: Float[Tensor, "k 1 3"]
    """Map minus truth [m]."""
    corner_error_world: Float[Tensor, "k 8 3"]
    """In the best cyclic order; zero in the slots past the number of corners."""
    corner_mask: Bool[Tensor, "k 8"]
    """All false where the survey has no corners or the numbers of corners differ."""
    relative_center_world: Float[Tensor, "k 1 3"]
    relative_corner_world: Float[Tensor, "k 8 3"]
    has_relative: Bool[Tensor, " k"]
    """True where enough signs stand around."""
    size_error: Float[Tensor, "k 2"]
    """Width and height, map minus truth [m]; NaN where the shapes differ or no corners were
    surveyed."""
    normal_deg: Float[Tensor, " k"]
    """Angle between the normals; NaN where none was surveyed."""
    same_shape: Bool[Tensor, " k"]
    observable: Bool[Tensor, " n"]
    """Of each survey sign, control signs excepted."""
    control: Bool[Tensor, " n"]
    """Of each survey sign."""

    def error_m(self, kind: str) -> Float[Tensor, " k"]:
        """The `absolute` or `relative` error of each sign: the mean over its corners, of its centre without them."""
        corner, center = self.corner_error_world, self.center_error_world
        if kind == "relative":
            corner, center = self.relative_corner_world, self.relative_center_world
        at_corners, _, _ = mean_lengths(corner, self.corner_mask)
        return at_corners.where(self.corner_mask.any(-1), center[:, 0].norm(dim=-1))


@dataclass(frozen=True)
class SignFigures:
    """METRICS.md's figures of signs; errors [m] are over matched observable signs."""

    map_signs: int
    """Control signs left out, here and everywhere."""
    true_signs: int
    observable: int
    matched: int
    matched_observable: int
    duplicates: int
    false: int
    recall: float
    precision: float
    median_shift: tuple[float, float, float]
    """East, north, up, of map minus truth over all matched signs."""
    absolute: PositionFigures
    """Mean over the corners of each sign."""
    absolute_center: PositionFigures
    relative: PositionFigures
    relative_center: PositionFigures
    width: ErrorFigures
    height: ErrorFigures
    normal_deg: ErrorFigures
    shape_accuracy: float
    close_pairs: int
    """Pairs of observable true signs on one post, facing one way."""
    close_pairs_told_apart: float
    """Share of them of which both are matched."""


def evaluate_signs(
    signs: Signs,
    survey: SurveySigns,
    *,
    observable: Bool[Tensor, " n"] | None = None,
    control: Bool[Tensor, " n"] | None = None,
    config: SignEvaluationConfig | None = None,
) -> SignFigures:
    """Figures of a table of signs against surveyed ones; cheap enough for every iteration.

    `observable` and `control` speak of the rows of `survey`; by default all are observable and
    none is a control point.
    """
    config = config or SignEvaluationConfig()
    return sign_figures(
        compare_signs(signs, survey, observable=observable, control=control, config=config),
        survey,
        config,
    )


def compare_signs(
    signs: Signs,
    survey: SurveySigns,
    *,
    observable: Bool[Tensor, " n"] | None = None,
    control: Bool[Tensor, " n"] | None = None,
    config: SignEvaluationConfig | None = None,
) -> SignComparison:
    """Each matched map sign beside its true sign, with all its errors."""
    config = config or SignEvaluationConfig()
    nothing = torch.zeros(len(survey), dtype=torch.bool, device=survey.shape.device)
    control = nothing if control is None else control
    observable = ~control if observable is None else observable & ~control
    match = match_to_survey(signs, survey, config.match)
    keep = ~control[match.true_row]
    map_row, true_row = match.map_row[keep], match.true_row[keep]
    matched, truth = signs[map_row], survey[true_row]
    corner_true, mask = _true_corners_in_map_order(matched, truth)
    corner_error = torch.where(mask[..., None], matched.corners_world - corner_true, 0.0)
    counted = observable[true_row]
    rest_center, rest_corner, enough = _relative_errors(
        matched.center_world,
        truth.center_world,
        torch.where(mask[..., None], matched.corners_world, 0.0),
        torch.where(mask[..., None], corner_true, 0.0),
        counted,
        config,
    )
    same_shape = matched.shape == truth.shape
    sized = same_shape & truth.has_corners
    size_error = matched.size - _size_of_corners(matched.shape, corner_true)
    # NaN where no normal was surveyed: acos(clamp(NaN)) stays NaN.
    cosine = (matched.normal_world * truth.normal_world).sum(-1).clamp(-1, 1)
    return SignComparison(
        match=match,
        map_row=map_row,
        true_row=true_row,
        counted=counted,
        center_error_world=(matched.center_world - truth.center_world)[:, None],
        corner_error_world=corner_error,
        corner_mask=mask,
        relative_center_world=rest_center[:, None],
        relative_corner_world=torch.where(mask[..., None], rest_corner, 0.0),
        has_relative=enough,
        size_error=torch.where(sized[:, None], size_error, torch.nan),
        normal_deg=torch.rad2deg(torch.acos(cosine)),
        same_shape=same_shape,
        observable=observable,
        control=control,
    )


def sign_figures(
    comparison: SignComparison, survey: SurveySigns, config: SignEvaluationConfig | None = None
) -> SignFigures:
    """The figures of a comparison."""
    config = config or SignEvaluationConfig()
    c, counted, kind = comparison, comparison.counted, comparison.match.true_of_map
    controlled = int((c.control[c.match.true_row]).sum())
    map_signs = len(kind) - controlled
    matched = len(c.map_row)
    observable = int(c.observable.sum())
    matched_observable = int(counted.sum())
    centre = torch.ones_like(c.center_error_world[..., 0], dtype=torch.bool)
    has_corners = c.corner_mask.any(-1)
    pairs, told_apart = _close_pairs(c, survey, config.close_pair_m)
    east, north, up = c.match.shift.tolist()
    return SignFigures(
        map_signs=map_signs,
        true_signs=len(survey) - int(c.control.sum()),
        observable=observable,
        matched=matched,
        matched_observable=matched_observable,
        duplicates=int((kind == DUPLICATE).sum()),
        false=int((kind == FALSE).sum()),
        recall=share(matched_observable, observable),
        precision=share(matched, map_signs),
        median_shift=(east, north, up),
        absolute=position_figures(c.corner_error_world, c.corner_mask, counted & has_corners),
        absolute_center=position_figures(c.center_error_world, centre, counted),
        relative=position_figures(
            c.relative_corner_world, c.corner_mask, counted & has_corners & c.has_relative
        ),
        relative_center=position_figures(c.relative_center_world, centre, counted & c.has_relative),
        width=error_figures(c.size_error[counted, 0].abs()),
        height=error_figures(c.size_error[counted, 1].abs()),
        normal_deg=error_figures(c.normal_deg[counted]),
        shape_accuracy=share(int((c.same_shape & counted).sum()), matched_observable),
        close_pairs=pairs,
        close_pairs_told_apart=share(told_apart, pairs),
    )


def _true_corners_in_map_order(
    matched: Signs, truth: SurveySigns
) -> tuple[Float[Tensor, "k 8 3"], Bool[Tensor, "k 8"]]:
    """True corners in the cyclic order nearest to the map's, and which slots can be compared.

    Signs with different numbers of corners cannot be compared corner by corner.
    """
    count = polygon.corner_count(matched.shape)
    comparable = truth.has_corners & (count == polygon.corner_count(truth.shape))
    corners = torch.where(comparable[:, None, None], truth.corners_world, matched.corners_world)
    shift, _ = polygon.best_shift(matched.corners_world, corners, count)
    ordered = polygon.roll(corners, shift, count)
    return ordered, polygon.corner_mask(matched.shape) & comparable[:, None]


def _size_of_corners(shape: Tensor, corners_world: Float[Tensor, "k 8 3"]) -> Float[Tensor, "k 2"]:
    """Width and height of signs whose first corner is their template's first."""
    template = polygon.template(shape).to(corners_world)
    mask = polygon.corner_mask(shape)[..., None]
    template = torch.where(mask, template, 0.0)
    centered = corners_world - _masked_mean(corners_world, mask)
    centered = torch.where(mask, centered, 0.0)
    # corner_k = x_axis w template_kx + y_axis h template_ky: two vectors, whose lengths are width
    # and height.
    gram = template.mT @ template
    axes = torch.linalg.solve(gram, template.mT @ centered)
    return axes.norm(dim=-1)


def _masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    return (value * mask).sum(-2, keepdim=True) / mask.sum(-2, keepdim=True)


def _relative_errors(
    center_map: Float[Tensor, "k 3"],
    center_true: Float[Tensor, "k 3"],
    corners_map: Float[Tensor, "k 8 3"],
    corners_true: Float[Tensor, "k 8 3"],
    counted: Bool[Tensor, " k"],
    config: SignEvaluationConfig,
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 8 3"], Bool[Tensor, " k"]]:
    """Errors that remain once the signs around each are brought onto the truth together.

    The translation and yaw minimise the squared distance of the centres of all counted signs
    around it, itself included.
    """
    one, other, _ = pairs_between(
        center_true, center_true[counted], radius=config.relative_radius_m
    )
    other = counted.nonzero()[:, 0][other]
    number = torch.zeros_like(center_map[:, 0]).index_add(
        0, one, torch.ones_like(center_map[one, 0])
    )
    scale = 1 / number.clamp_min(1)[:, None]

    def around(value: Tensor) -> Tensor:
        """Sums over the neighbours of each sign."""
        out = value.new_zeros(len(center_map), value.shape[-1])
        return out.index_add(0, one, value)

    # Relative to the sign itself, so that a map far from its origin loses no digits.
    ahead_map = center_map[other] - center_map[one]
    ahead_true = center_true[other] - center_true[one]
    mean_map, mean_true = around(ahead_map) * scale, around(ahead_true) * scale
    p, q = ahead_map - mean_map[one], ahead_true - mean_true[one]
    turn = around(
        torch.stack(
            (p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1], p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), dim=-1
        )
    )
    yaw = torch.atan2(turn[:, 1], turn[:, 0])
    cos, sin, zero, unit = yaw.cos(), yaw.sin(), torch.zeros_like(yaw), torch.ones_like(yaw)
    rotation = torch.stack((cos, -sin, zero, sin, cos, zero, zero, zero, unit), dim=-1)
    rotation = rotation.reshape(-1, 3, 3)

    def moved(p_map: Float[Tensor, "k n 3"]) -> Float[Tensor, "k n 3"]:
        own = p_map - center_map[:, None] - mean_map[:, None]
        return own @ rotation.mT + mean_true[:, None] + center_true[:, None]

    enough = number >= config.relative_min_signs
    rest_center = moved(center_map[:, None])[:, 0] - center_true
    return rest_center, moved(corners_map) - corners_true, enough


def _close_pairs(comparison: SignComparison, survey: SurveySigns, radius: float) -> tuple[int, int]:
    """Pairs of observable signs on one post that face one way, and how many are both matched."""
    one, other, _ = pairs_between(survey.center_world, survey.center_world, radius=radius)
    facing = (survey.normal_world[one] * survey.normal_world[other]).sum(-1)
    seen = comparison.observable[one] & comparison.observable[other]
    pair = (one < other) & seen & ~(facing < 0)
    found = torch.zeros_like(comparison.observable).index_fill(0, comparison.true_row, True)
    return int(pair.sum()), int((pair & found[one] & found[other]).sum())
