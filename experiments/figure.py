"""The figure of an experiment: lines over one column, or bars by group. Needs matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from experiments.study import Experiment, Group

LABELS = {"e3d_percent": "3D error, percent", "seconds": "seconds"}
FLOOR = 1e-3
"""Smaller values are drawn as this; they are exact for all purposes."""


def draw(experiment: Experiment, groups: Sequence[Group], path: Path) -> None:
    """Write the figure as PNG; nothing where no run succeeded."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    groups = [each for each in groups if each.runs]
    if not groups:
        return
    figure, axes = plt.subplots(figsize=(8.0, max(4.5, 0.22 * len(groups) * (experiment.x is None))))
    if experiment.x is None:
        _bars(axes, experiment.measure, groups)
    else:
        _lines(axes, experiment.x, experiment.measure, groups)
    axes.set_title(experiment.title, fontsize=10)
    axes.grid(axis="x" if experiment.x is None else "y", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _bars(axes: Axes, measure: str, groups: Sequence[Group]) -> None:
    names = [", ".join(each.keys.values()) for each in groups]
    spread = [each.spread[measure] for each in groups]
    axes.barh(names, [_drawn(each, measure) for each in groups], xerr=spread, capsize=2)
    axes.invert_yaxis()
    axes.tick_params(axis="y", labelsize=7)
    axes.set(xlabel=LABELS[measure], xscale="log")


def _lines(axes: Axes, x: str, measure: str, groups: Sequence[Group]) -> None:
    """One line for every combination of the other keys; numbers keep their distances, other values their order."""
    series: dict[str, list[Group]] = {}
    for each in groups:
        series.setdefault(", ".join(value for key, value in each.keys.items() if key != x), []).append(each)
    places = list(dict.fromkeys(each.keys[x] for each in groups))
    numeric = all(_is_number(place) for place in places)
    for name, members in series.items():
        at = [float(each.keys[x]) if numeric else places.index(each.keys[x]) for each in members]
        spread = [each.spread[measure] for each in members]
        axes.errorbar(at, [_drawn(each, measure) for each in members], spread, marker="o", capsize=2, label=name)
    if not numeric:
        axes.set_xticks(range(len(places)), places)
    axes.set(xlabel=x, ylabel=LABELS[measure], yscale="log")
    axes.legend(fontsize=7)


def _drawn(each: Group, measure: str) -> float:
    return max(each.mean[measure], FLOOR)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
