"""What the accuracy runs of a row of data amount to: figures against what is to be reached, and what falls short."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from experiments.study import FAILURE, SEED

RUNS = DEFAULT, START, PAPER = ("default", "before refinement", "paper mode")
OUTLIERS = 1.3
"""Error with wrong tracks over that without, at most."""
FLAGS = 0.9
"""Precision and recall of the flags of wrong tracks, at least."""
SCALE = 0.98
"""Correlation of the recovered and the true log conformal scale, at least."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """What is to be reached on one row of data."""

    name: str
    bound: tuple[float, float] = (math.inf, math.inf)
    """3D error in percent and shape error in degrees."""
    known: str = ""
    """Best figures known of other methods."""
    model: str | None = None
    """The model that must be chosen."""
    isometric_views: tuple[int, ...] = ()
    """Views that are declared isometric: then the conformal scale must be right, and no alternative counts."""
    clean: str | None = None
    """The row without wrong tracks, with which the error is compared."""


Runs = Mapping[tuple[str, str], Sequence[Mapping[str, str]]]
"""Lines of the CSV by row and run."""


def table(rows: Sequence[Target], runs: Runs) -> str:
    """The Markdown table of the rows that were run."""
    head = ("3D error % / shape error deg", "default", "to reach", "known elsewhere", START, PAPER, "further", "holds")
    text = [_line(head), _line(["---"] * len(head))]
    for row in rows:
        errors = {name: _errors(row, runs.get((row.name, name), ())) for name in RUNS}
        if errors[DEFAULT]:
            cells = [_pair(errors[name]) for name in RUNS]
            missed = "; ".join(misses(row, runs))
            reach = _bound(row, runs)
            cells = [row.name, cells[0], _figures(*reach), row.known, *cells[1:], _further(row, runs), missed or "yes"]
            text.append(_line(cells))
    return "\n".join(text) + "\n"


def misses(row: Target, runs: Runs) -> list[str]:
    """What a row falls short of, in words; empty where all holds."""
    default = runs[row.name, DEFAULT]
    good = _good(default)
    missed = [f"{len(default) - len(good)} failed"] * (len(good) < len(default))
    (error, shape), (least, steepest) = _mean(_errors(row, default)), _bound(row, runs)
    if error > least:
        missed.append("3D error")
    if shape > steepest:
        floor = statistics.fmean(float(line["floor"]) for line in good)
        missed.append(f"shape error, {floor:.2f} for the truth itself" if floor > steepest else "shape error")
    if row.model and any(line["model"] != row.model for line in good):
        missed.append("model")
    for name, wanted in (("precision", FLAGS), ("recall", FLAGS), *[("scale", SCALE)] * bool(row.isometric_views)):
        if (value := _average(good, name)) is not None and value < wanted:
            missed.append(name)
    for name in (START, PAPER):
        others = {line[SEED]: line for line in _good(runs.get((row.name, name), ()))}
        pairs = [(line, others[line[SEED]]) for line in good if line[SEED] in others]
        worse = [line[SEED] for line, other in pairs if _errors(row, [line])[0][0] > float(other["error"])]
        if worse:
            missed.append(f"worse than {name} on seed {', '.join(worse)}")
    return missed


def _good(lines: Sequence[Mapping[str, str]]) -> list[Mapping[str, str]]:
    return [line for line in lines if not line[FAILURE]]


def _errors(row: Target, lines: Sequence[Mapping[str, str]]) -> list[tuple[float, float]]:
    """3D and shape error of every run; where a run reports an alternative and nothing is declared, of the better."""
    errors = []
    for line in _good(lines):
        candidates = [(float(line["error"]), float(line["shape"]))]
        if line["alternative_error"]:
            candidates.append((float(line["alternative_error"]), float(line["alternative_shape"])))
        errors.append(min(candidates[: 1 if row.isometric_views else 2]))
    return errors


def _bound(row: Target, runs: Runs) -> tuple[float, float]:
    """What is to be reached; with wrong tracks it depends on the error without."""
    clean = _errors(row, runs.get((row.clean or "", DEFAULT), ()))
    return (OUTLIERS * _mean(clean)[0], math.inf) if clean else row.bound


def _further(row: Target, runs: Runs) -> str:
    """Model, flags of wrong tracks, conformal scale, alternatives."""
    good = _good(runs[row.name, DEFAULT])
    parts = [" or ".join(sorted({line["model"] for line in good}))]
    if (precision := _average(good, "precision")) is not None:
        parts.append(f"flags right {precision:.2f}, found {_average(good, 'recall'):.2f}")
    if row.isometric_views:
        parts.append(f"log scale correlates {_average(good, 'scale'):.3f}")
    reported = [line for line in good if line["alternative_error"]]
    if reported:
        better = sum(float(line["alternative_error"]) < float(line["error"]) for line in reported)
        parts.append(f"ambiguity reported {len(reported)}/{len(good)}, the alternative is right {better}/{len(good)}")
    return ", ".join(part for part in parts if part)


def _average(lines: Sequence[Mapping[str, str]], name: str) -> float | None:
    values = [float(line[name]) for line in lines if line[name]]
    return statistics.fmean(values) if values else None


def _mean(errors: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return (
        (statistics.fmean(e for e, _ in errors), statistics.fmean(s for _, s in errors)) if errors else (math.inf,) * 2
    )


def _pair(errors: Sequence[tuple[float, float]]) -> str:
    return "{:.3f} / {:.2f}".format(*_mean(errors)) if errors else ""


def _figures(error: float, shape: float) -> str:
    return " / ".join(f"{value:.3g}" for value in (error, shape) if math.isfinite(value))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
