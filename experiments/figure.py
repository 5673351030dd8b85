"""The figure of an experiment: lines over one column, or bars by group. Needs matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from experiments.study import Experiment, Group

LABELS = {"e3d_percent": "3D error, percent", "shape_error_deg": "shape error, degrees", "seconds": "seconds"}


def draw(experiment: Experiment, groups: Sequence[Group], path: Path) -> None:
    """Write the figure as PNG; nothing where no run succeeded."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    groups = [each for each in groups if each.runs]
    if not groups:
        return
    figure, axes = plt.subplots(figsize=(8.0, 4.5), constrained_layout=True)
    if experiment.x is None:
        _bars(axes, experiment.measure, groups)
    else:
        _lines(axes, experiment.x, experiment.measure, groups)
    axes.set(ylabel=LABELS[experiment.measure], yscale="log")
    axes.set_title(experiment.title, fontsize=10)
    axes.grid(axis="y", which="both", alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _bars(axes, measure: str, groups: Sequence[Group]) -> None:
    names = [", ".join(each.keys.values()) for each in groups]
    axes.bar(names, [each.mean[measure] for each in groups], yerr=[each.spread[measure] for each in groups], capsize=2)
    axes.tick_params(axis="x", labelrotation=60, labelsize=7)


def _lines(axes, x: str, measure: str, groups: Sequence[Group]) -> None:
    """One line for every combination of the other keys; numbers keep their distances, other values their order."""
    series: dict[str, list[Group]] = {}
    for each in groups:
        series.setdefault(", ".join(value for key, value in each.keys.items() if key != x), []).append(each)
    places = list(dict.fromkeys(each.keys[x] for each in groups))
    numeric = all(_is_number(place) for place in places)
    for name, members in series.items():
        at = [float(each.keys[x]) if numeric else places.index(each.keys[x]) for each in members]
        mean = [each.mean[measure] for each in members]
        axes.errorbar(at, mean, [each.spread[measure] for each in members], marker="o", capsize=2, label=name)
    if not numeric:
        axes.set_xticks(range(len(places)), places)
    axes.set_xlabel(x)
    axes.legend(fontsize=7)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
