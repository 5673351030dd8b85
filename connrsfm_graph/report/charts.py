"""Charts as inline SVG text, coloured by the page's style sheet so that they follow light and dark."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

import numpy as np

WIDTH = 460
"""Of a chart in its own units; the page scales charts to their column."""
LEFT, RIGHT, TOP, BOTTOM = 46, 14, 14, 30
MAX_LABELS = 16


def bar_chart(values: Sequence[float | None], labels: Sequence[str], unit: str, height: int = 190) -> str:
    """One bar per label from zero; None leaves a gap. A dashed line marks the mean."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    axis = _Axis.linear(0.0, max(known), TOP, height - BOTTOM)
    step = (WIDTH - LEFT - RIGHT) / len(values)
    parts = [axis.drawn(unit)]
    for i, value in enumerate(values):
        if value is not None:
            y = axis.place(value)
            title = f"<title>{html.escape(labels[i])}: {value:.3g} {html.escape(unit)}</title>"
            parts.append(
                f'<rect class="bar" x="{LEFT + (i + 0.14) * step:.1f}" y="{y:.1f}" width="{0.72 * step:.1f}" '
                f'height="{axis.bottom - y:.1f}" rx="1.5">{title}</rect>'
            )
    mean = axis.place(sum(known) / len(known))
    parts.append(f'<line class="mean" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{mean:.1f}" y2="{mean:.1f}"/>')
    parts.append(_labels_below(labels, step, height))
    return _svg(parts, height)


def range_chart(
    ranges: Sequence[tuple[float, float, float] | None], labels: Sequence[str], unit: str, height: int = 190
) -> str:
    """Low, middle and high of each label as a stroke and a dot on a logarithmic axis; None leaves a gap."""
    known = [item for item in ranges if item is not None]
    if not known:
        return ""
    axis = _Axis.logarithmic(min(item[0] for item in known), max(item[2] for item in known), TOP, height - BOTTOM)
    step = (WIDTH - LEFT - RIGHT) / len(ranges)
    parts = [axis.drawn(unit)]
    for i, item in enumerate(ranges):
        if item is not None:
            x = LEFT + (i + 0.5) * step
            low, middle, high = (axis.place(value) for value in item)
            title = f"<title>{html.escape(labels[i])}: {item[1]:.3g} ({item[0]:.3g} to {item[2]:.3g})</title>"
            parts.append(f'<g>{title}<line class="range" x1="{x:.1f}" x2="{x:.1f}" y1="{low:.1f}" y2="{high:.1f}"/>')
            parts.append(f'<circle class="dot" cx="{x:.1f}" cy="{middle:.1f}" r="3.2"/></g>')
    parts.append(_labels_below(labels, step, height))
    return _svg(parts, height)


def line_chart(series: Mapping[str, Sequence[float]], unit: str, height: int = 190) -> str:
    """Positive values over their index, one line per name, on a logarithmic axis; other values leave gaps."""
    series = {name: values for name, values in series.items() if len(values) > 1}
    shown = [value for values in series.values() for value in values if _positive(value)]
    if not shown:
        return ""
    axis = _Axis.logarithmic(min(shown), max(shown), TOP, height - BOTTOM)
    longest = max(len(values) for values in series.values())
    step = (WIDTH - LEFT - RIGHT) / max(longest - 1, 1)
    parts = [axis.drawn(unit)]
    for k, values in enumerate(series.values()):
        points = [(LEFT + i * step, axis.place(value)) for i, value in enumerate(values) if _positive(value)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<polyline class="line s{k % 4}" points="{path}"/>')
        parts += [f'<circle class="point s{k % 4}" cx="{x:.1f}" cy="{y:.1f}" r="2"/>' for x, y in points[:200]]
    every = max(1, math.ceil((longest - 1) / 8))
    for i in range(0, longest, every):
        parts.append(f'<text class="below" x="{LEFT + i * step:.1f}" y="{height - BOTTOM + 16}">{i}</text>')
    legend = "".join(f'<span class="s{k % 4}">{html.escape(name)}</span>' for k, name in enumerate(series))
    return _svg(parts, height) + (f'<p class="legend">{legend}</p>' if len(series) > 1 else "")


def duration_chart(seconds: Mapping[str, float]) -> str:
    """Horizontal bars of seconds, named on the left."""
    if not seconds:
        return ""
    row, left, right = 24, 150, 62
    longest = max(max(seconds.values()), 1e-9)
    parts = []
    for i, (name, value) in enumerate(seconds.items()):
        width = max((WIDTH - left - right) * value / longest, 1.0)
        middle = i * row + 0.5 * row
        parts.append(f'<text class="name" x="{left - 10}" y="{middle + 4:.1f}">{html.escape(name)}</text>')
        parts.append(f'<rect class="bar" x="{left}" y="{middle - 6:.1f}" width="{width:.1f}" height="12" rx="1.5"/>')
        parts.append(f'<text x="{left + width + 7:.1f}" y="{middle + 4:.1f}">{value:.2f} s</text>')
    return _svg(parts, row * len(seconds))


def graph_chart(n_nodes: int, edges: np.ndarray, weight: np.ndarray, n_shown_labels: int = 40) -> str:
    """Nodes on a circle and edges between them, the heavier the stronger."""
    size, radius = 300, 122
    angle = 2 * np.pi * np.arange(n_nodes) / max(n_nodes, 1) - np.pi / 2
    place = np.stack([WIDTH / 2 + radius * np.cos(angle), size / 2 + radius * np.sin(angle)], axis=1)
    largest = max(float(np.max(weight, initial=0.0)), np.finfo(float).tiny)
    parts = []
    for (a, b), w in sorted(zip(edges.tolist(), weight.tolist(), strict=True), key=lambda item: item[1]):
        (x1, y1), (x2, y2) = place[a], place[b]
        share = max(w / largest, 0.0)
        parts.append(
            f'<line class="edge" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
            f'stroke-opacity="{0.25 + 0.75 * share:.2f}" stroke-width="{0.6 + 1.8 * share:.2f}">'
            f"<title>{a} – {b}: weight {w:.4g}</title></line>"
        )
    every = max(1, math.ceil(n_nodes / n_shown_labels))
    for node, (x, y) in enumerate(place):
        parts.append(f'<circle class="node" cx="{x:.1f}" cy="{y:.1f}" r="{3.4 if n_nodes < 60 else 2}"/>')
        if node % every == 0:
            lx, ly = WIDTH / 2 + (x - WIDTH / 2) * 1.12, size / 2 + (y - size / 2) * 1.12
            parts.append(f'<text class="below" x="{lx:.1f}" y="{ly + 4:.1f}">{node}</text>')
    return _svg(parts, size)


class _Axis:
    """A vertical axis: values to heights, and ticks at round values."""

    def __init__(self, lower: float, upper: float, ticks: list[float], logarithmic: bool, top: float, bottom: float):
        self.lower, self.upper, self.ticks, self.top, self.bottom = lower, upper, ticks, top, bottom
        self._scale = math.log if logarithmic else float

    @staticmethod
    def linear(lower: float, upper: float, top: float, bottom: float) -> _Axis:
        raw = max(upper - lower, 1e-12) / 4
        magnitude = 10.0 ** math.floor(math.log10(raw))
        step = magnitude * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * magnitude >= raw * (1 - 1e-9))
        count = math.ceil((upper - lower) / step - 1e-9)
        ticks = [lower + i * step for i in range(max(count, 1) + 1)]
        return _Axis(lower, ticks[-1], ticks, False, top, bottom)

    @staticmethod
    def logarithmic(lower: float, upper: float, top: float, bottom: float) -> _Axis:
        margin = (upper / lower) ** 0.06 * 1.02
        lower, upper = lower / margin, upper * margin
        decades = math.log10(upper / lower)
        if decades < 1:
            inner = _Axis.linear(lower, upper, top, bottom)
            step = inner.ticks[1] - inner.ticks[0]
            first = math.ceil(lower / step)
            ticks = [i * step for i in range(first, math.floor(upper / step) + 1)]
        else:
            every = math.ceil(decades / 6)
            ticks = [10.0**k for k in range(math.ceil(math.log10(lower)), math.floor(math.log10(upper)) + 1, every)]
        return _Axis(lower, upper, ticks, True, top, bottom)

    def place(self, value: float) -> float:
        value, lower, upper = (self._scale(number) for number in (value, self.lower, self.upper))
        return self.bottom - (self.bottom - self.top) * (value - lower) / (upper - lower)

    def drawn(self, unit: str) -> str:
        parts = []
        for tick in self.ticks:
            y = self.place(tick)
            parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text class="tick" x="{LEFT - 7}" y="{y + 4:.1f}">{tick:.4g}</text>')
        return "".join(parts) + f'<text class="unit" x="{WIDTH - RIGHT}" y="{self.top - 4}">{html.escape(unit)}</text>'


def _labels_below(labels: Sequence[str], step: float, height: int) -> str:
    widest = max(len(label) for label in labels)
    every = max(1, math.ceil(len(labels) * max(widest / 4, 1) / MAX_LABELS))
    return "".join(
        f'<text class="below" x="{LEFT + (i + 0.5) * step:.1f}" y="{height - BOTTOM + 16}">{html.escape(label)}</text>'
        for i, label in enumerate(labels)
        if i % every == 0
    )


def _positive(value: float | None) -> bool:
    return value is not None and math.isfinite(value) and value > 0


def _svg(parts: Sequence[str], height: int) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'
