"""Small charts for pages: SVG whose colours are the page's own, so that they turn dark with it, and as wide as a phone.

A chart is `WIDTH` units wide and is shown at about as many pixels: its letters stay as large as those of the text.
Lines have no more points than there are pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape

WIDTH, HEIGHT = 360, 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 8, 8, 36
_MOST_POINTS = 2 * WIDTH
_MOST_DIGITS = 4.5
"""Of a number on the axis, between its label and its line."""
_MOST_LETTERS = 7
"""Of a name on the axis."""
_HALF_LETTER = 3.4
"""Half the width of a letter."""
SERIES = ("map", "before", "survey", "violet", "bad", "teal", "soft")
"""Colours of several lines: names of variables of the page's style."""


@dataclass(frozen=True)
class Mark:
    """Something that is drawn: its colour is a variable of the page's style, its label stands in the legend."""

    x: Sequence[float]
    y: Sequence[float]
    color: str = "map"
    label: str = ""
    title: str = ""
    """Shown when the pointer rests on it."""


@dataclass(frozen=True)
class Line(Mark):
    """Points joined by a line, with gaps where a number is not finite."""

    width: float = 1.5
    dash: str = ""


@dataclass(frozen=True)
class Dots(Mark):
    """Points by themselves."""

    radius: float = 2.5
    hollow: bool = False
    titles: Sequence[str] = ()
    """One for each point."""


@dataclass(frozen=True)
class Segments(Mark):
    """Strokes: each two points that follow one another are the ends of one."""

    width: float = 1.5
    arrow: bool = False
    """With a dot at the end of each."""


@dataclass(frozen=True)
class Bars(Mark):
    """Bars from zero to `y`, around `x`."""

    width: float = 1.0
    """Of a bar, in units of x."""
    opacity: float = 0.75


@dataclass(frozen=True)
class Tiles(Mark):
    """Squares around `x` and `y`, the darker the nearer their value is to the largest."""

    value: Sequence[float] = ()
    side: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Chart:
    """Marks in a frame with axes."""

    title: str
    marks: Sequence[Mark]
    x_label: str = ""
    y_label: str = ""
    log_x: bool = False
    log_y: bool = False
    from_zero: bool = False
    """Whether the vertical axis begins at zero."""
    equal: bool = False
    """Whether a unit is as long on both axes."""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    """From the bottom up; the larger number first turns the axis round."""
    rules_x: Sequence[tuple[float, str, str]] = field(default_factory=tuple)
    """Upright lines: where, colour, and label for the legend."""
    rules_y: Sequence[tuple[float, str, str]] = field(default_factory=tuple)
    y_names: Sequence[str] = ()
    """Names of 0, 1, 2 ... on the axis, instead of numbers."""
    height: int = HEIGHT


def charts_html(charts: Iterable[Chart]) -> str:
    """Charts side by side where there is room, each with its legend."""
    boxes = "".join(
        f'<figure class="chart"><figcaption>{escape(chart.title)}{_legend(chart)}</figcaption>'
        f"{svg(chart)}</figure>"
        for chart in charts
    )
    return f'<div class="charts">{boxes}</div>' if boxes else ""


def svg(chart: Chart) -> str:
    """The chart as an SVG element."""
    across = _Axis.of(_values(chart, 0), (_LEFT, WIDTH - _RIGHT), chart.log_x, chart.x_range, ())
    up = _Axis.of(
        [*_values(chart, 1), *([0.0] if chart.from_zero else [])],
        (chart.height - _BOTTOM, _TOP),
        chart.log_y,
        chart.y_range,
        chart.y_names,
    )
    if chart.equal:
        across, up = across.like(up), up.like(across)
    grid = "".join(_grid(across, up, chart))
    rules = "".join(
        f'<path class="rule" style="stroke:var(--{color})" d="{d}"/>'
        for d, color in (
            *((f"M{across(v):.1f} {_TOP}V{up.low_px}", c) for v, c, _ in chart.rules_x),
            *((f"M{_LEFT} {up(v):.1f}H{WIDTH - _RIGHT}", c) for v, c, _ in chart.rules_y),
        )
    )
    marks = "".join(_drawn(mark, across, up) for mark in chart.marks)
    return (
        f'<svg viewBox="0 0 {WIDTH} {chart.height}" role="img" aria-label="{escape(chart.title)}">'
        f"{grid}{rules}{marks}</svg>"
    )


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    low_px: float
    high_px: float
    log: bool = False
    names: Sequence[str] = ()

    @classmethod
    def of(
        cls,
        values: Sequence[float],
        px: tuple[float, float],
        log: bool,
        given: tuple[float, float] | None,
        names: Sequence[str],
    ) -> _Axis:
        if given is not None:
            return cls(*given, *px, log, names)
        known = [v for v in values if math.isfinite(v) and (v > 0 or not log)]
        low, high = (min(known), max(known)) if known else (0.1 if log else 0.0, 1.0)
        if log:
            return cls(low / 1.2, high * 1.2, *px, log)
        room = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
        return cls(low if low == 0 else low - room, high + room, *px, log, names)

    def __call__(self, value: float) -> float:
        """Where a value is [px]."""
        a, b, v = self.low, self.high, value
        if self.log:
            a, b, v = math.log10(a), math.log10(b), math.log10(max(v, 1e-300))
        return self.low_px + (v - a) / (b - a) * (self.high_px - self.low_px)

    def like(self, other: _Axis) -> _Axis:
        """The same middle, wide enough that a unit is no longer than on the other axis."""
        px, other_px = abs(self.high_px - self.low_px), abs(other.high_px - other.low_px)
        span = max(self.high - self.low, (other.high - other.low) * px / other_px)
        middle = (self.low + self.high) / 2
        return _Axis(middle - span / 2, middle + span / 2, self.low_px, self.high_px)

    def ticks(self) -> list[tuple[float, str]]:
        """Round values and how they are written."""
        low, high = sorted((self.low, self.high))
        # Across, numbers stand beside one another.
        most = max(abs(self.high_px - self.low_px) / (55 if self.low_px < self.high_px else 34), 2)
        if self.names:
            return list(enumerate(_told_apart(self.names)))
        if self.log:
            found = _log_ticks(low, high, most)
            return [*zip(found, _written([f"{v:g}" for v in found], found), strict=True)]
        raw = (high - low) / most
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(power * k for k in (1, 2, 5, 10) if power * k >= raw * 0.999)
        first = math.ceil(low / step - 1e-9)
        digits = max(-math.floor(math.log10(step) + 1e-9), 0)
        found = [k * step for k in range(first, int(high / step + 1e-9) + 1)]
        return [*zip(found, _written([f"{v:,.{digits}f}" for v in found], found), strict=True)]


def _written(words: list[str], values: Sequence[float]) -> list[str]:
    """Numbers of an axis as they are, or in thousands or millions where they would reach the axis' own label."""
    for unit, letter in ((1e3, "k"), (1e6, "M")):
        if max(map(_letters, words), default=0) <= _MOST_DIGITS or max(map(abs, values)) < unit:
            break
        words = [f"{v / unit:g}{letter if v else ''}" for v in values]
    return words


def _letters(number: str) -> float:
    """How wide a number is, in digits."""
    return sum(0.5 if c in ".,-" else 1.0 for c in number)


def _told_apart(names: Sequence[str]) -> list[str]:
    """The names without the words that all begin with, and of what is left no more than there is room for."""
    first, last = min(names), max(names)
    alike = (k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    same = first[: next(alike, 0)]
    same = same[: max(same.rfind(mark) for mark in "-_. /") + 1]
    rest = [name[len(same) :] for name in names]
    return [
        name if len(name) <= _MOST_LETTERS else f"…{name[1 - _MOST_LETTERS :]}" for name in rest
    ]


def _log_ticks(low: float, high: float, most: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        found = [f * 10.0**d for d in decades for f in factors if low <= f * 10.0**d <= high]
        if len(found) <= most + 1:
            break
    step = max(math.ceil(len(found) / (most + 1)), 1)
    return found[::step]


def _grid(across: _Axis, up: _Axis, chart: Chart) -> Iterator[str]:
    for value, name in across.ticks():
        x = across(value)
        yield f'<path class="grid" d="M{x:.1f} {_TOP}V{up.low_px}"/>'
        x = min(x, WIDTH - _HALF_LETTER * len(name))
        yield f'<text x="{x:.1f}" y="{up.low_px + 14}" text-anchor="middle">{escape(name)}</text>'
    for value, name in up.ticks():
        y = up(value)
        yield f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>'
        yield f'<text x="{_LEFT - 5}" y="{y + 3.5:.1f}" text-anchor="end">{escape(name)}</text>'
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    label = '<text class="label" text-anchor="middle" {}>{}</text>'
    yield label.format(f'x="{middle:.0f}" y="{chart.height - 5}"', escape(chart.x_label))
    turned = f'transform="translate(11 {(up.low_px + _TOP) / 2:.0f}) rotate(-90)"'
    yield label.format(turned, escape(chart.y_label))


def _drawn(mark: Mark, across: _Axis, up: _Axis) -> str:
    title = f"<title>{escape(mark.title)}</title>" if mark.title else ""
    color = f"var(--{mark.color})"
    if isinstance(mark, Bars):
        zero = up(0.0) if not up.log else up.low_px
        bars = "".join(
            f"M{across(x - mark.width / 2):.1f} {zero:.1f}V{up(y):.1f}H{across(x + mark.width / 2):.1f}V{zero:.1f}Z"
            for x, y in zip(mark.x, mark.y, strict=True)
            if math.isfinite(y) and y
        )
        return f'<path style="fill:{color};opacity:{mark.opacity}" d="{bars}">{title}</path>'
    if isinstance(mark, Tiles):
        return _tiles(mark, across, up)
    points = [
        (across(x), up(y)) if math.isfinite(x) and math.isfinite(y) else None
        for x, y in _thinned(mark)
    ]
    if isinstance(mark, Dots):
        fill = "var(--card)" if mark.hollow else color
        names = [f"<title>{escape(t)}</title>" for t in mark.titles] or [""] * len(points)
        circles = "".join(
            f'<circle cx="{p[0]:.1f}" cy="{p[1]:.1f}" r="{mark.radius}">{name}</circle>'
            for p, name in zip(points, names, strict=False)
            if p is not None
        )
        return f'<g style="fill:{fill};stroke:{color}">{circles}{title}</g>'
    if isinstance(mark, Segments):
        pairs = [(a, b) for a, b in zip(points[::2], points[1::2], strict=False) if a and b]
        d = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in pairs)
        ends = "".join(f'<circle cx="{b[0]:.1f}" cy="{b[1]:.1f}" r="2.5"/>' for _, b in pairs)
        dots = f'<g style="fill:{color}">{ends}</g>' if mark.arrow else ""
        line = f'<path class="line" style="stroke:{color};stroke-width:{mark.width}" d="{d}">{title}</path>'
        return line + dots
    dash = ""
    width = 1.5
    if isinstance(mark, Line):
        width, dash = mark.width, f";stroke-dasharray:{mark.dash}" if mark.dash else ""
    d, pen = "", "M"
    for p in points:
        d, pen = (d, "M") if p is None else (f"{d}{pen}{p[0]:.1f} {p[1]:.1f}", "L")
    return f'<path class="line" style="stroke:{color};stroke-width:{width}{dash}" d="{d}">{title}</path>'


def _tiles(mark: Tiles, across: _Axis, up: _Axis) -> str:
    most = max((v for v in mark.value if math.isfinite(v)), default=0.0) or 1.0
    half = mark.side / 2
    return "".join(
        f'<path style="fill:var(--{mark.color});opacity:{0.06 + 0.94 * v / most:.2f}" d="M{across(x - half):.1f} '
        f'{up(y - half):.1f}H{across(x + half):.1f}V{up(y + half):.1f}H{across(x - half):.1f}Z">'
        f"<title>{v:.2f}{escape(mark.unit)}</title></path>"
        for x, y, v in zip(mark.x, mark.y, mark.value, strict=True)
        if math.isfinite(v)
    )


def _thinned(mark: Mark) -> Iterator[tuple[float, float]]:
    """Every so many points of a line; dots and strokes as they are."""
    pairs = list(zip(mark.x, mark.y, strict=True))
    step = max(math.ceil(len(pairs) / _MOST_POINTS), 1) if isinstance(mark, Line) else 1
    yield from pairs[::step]
    if step > 1 and (len(pairs) - 1) % step:
        yield pairs[-1]


def _values(chart: Chart, axis: int) -> list[float]:
    found = [v for mark in chart.marks for v in ((mark.x, mark.y)[axis])]
    rules = (chart.rules_x, chart.rules_y)[axis]
    return [*found, *(place for place, _, _ in rules)]


def _legend(chart: Chart) -> str:
    named = [(m.color, m.label, "") for m in chart.marks if m.label]
    named += [(c, name, " dashed") for _, c, name in (*chart.rules_x, *chart.rules_y) if name]
    return "".join(
        f'<span><i class="key{kind}" style="color:var(--{color})"></i>{escape(name)}</span>'
        for color, name, kind in dict.fromkeys(named)
    )
