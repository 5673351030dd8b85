"""From images to surfaces on a real cloth: tracks of our front end against a depth camera.

Ten evenly spaced of the 50 images of `experiments.loaders.cloth_r1`. The error of a point is its distance to the truth
after the surface of its image is aligned by a similarity, in percent of the truth's largest extent; a row holds the
median of an image. Beside it the error of the plane that fits the truth best, seen along the same sight rays: what a
method scores that knows everything but the shape.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.methods import METHODS
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.progress import Progress
from connrsfm_graph.tracks import Tracks, check_reconstructable
from experiments.loaders.cloth_r1 import load_cloth
from experiments.study import VARIANTS, Options, save

SHOWN = ("default", "paper mode")
FOLDER = "cloth_r1"


@dataclass(frozen=True)
class Row:
    """The error of one method in one image, or in all."""

    method: str
    image: str
    points: int
    median_percent: float
    plane_percent: float
    seconds: float


def compare(tracks: Tracks, name: str) -> list[Row]:
    """A row per image and one for all, of a method on tracks with truth."""
    method, config = VARIANTS[name]
    start = time.perf_counter()
    reconstruction, _ = METHODS[method](check_reconstructable(tracks)[0], config, Progress())
    seconds = time.perf_counter() - start
    rows, errors, planes = [], [], []
    for f in range(tracks.n_frames):
        error, plane = image_errors(reconstruction.points[f], truth_of(tracks)[f])
        rows.append(
            Row(
                name,
                reconstruction.frame_name(f),
                len(error),
                float(np.median(error)),
                float(np.median(plane)),
                seconds,
            )
        )
        errors.append(error)
        planes.append(plane)
    every, flat = np.concatenate(errors), np.concatenate(planes)
    return [*rows, Row(name, "all", len(every), float(np.median(every)), float(np.median(flat)), seconds)]


def truth_of(tracks: Tracks) -> np.ndarray:
    """(F, P, 3) the tracks' true points."""
    assert tracks.points is not None, "an experiment needs tracks with truth"
    return tracks.points


def image_errors(points: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N,) of points (P, 3) in percent of the extent of the truth (P, 3), and those of its best plane."""
    known = np.isfinite(points).all(axis=1) & np.isfinite(truth).all(axis=1)
    points, truth = points[known], truth[known]
    extent = np.ptp(truth, axis=0).max()
    s, R, t = align_similarity(points, truth)
    error = np.linalg.norm(s * points @ R.T + t - truth, axis=1)
    centre = truth.mean(axis=0)
    normal = np.linalg.svd(truth - centre)[2][2]
    on_plane = truth * ((centre @ normal) / (truth @ normal))[:, None]
    s, R, t = align_similarity(on_plane, truth)
    plane = np.linalg.norm(s * on_plane @ R.T + t - truth, axis=1)
    return 100 * error / extent, 100 * plane / extent


def markdown(rows: Sequence[Row]) -> str:
    """One line per method and image."""
    lines = [
        "### Hanging cloth R1: 10 of 50 images, tracked",
        "",
        "| method | image | points | median error % | plane % | seconds |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        figures = f"{row.points} | {row.median_percent:.2f} | {row.plane_percent:.2f} | {row.seconds:.1f}"
        lines.append(f"| {row.method} | {row.image} | {figures} |")
    return "\n".join(lines) + "\n"


def measure(options: Options) -> None:
    """Write cloth.csv and cloth.md; nothing in a quick run or where the data are absent."""
    folder = options.data / FOLDER
    if options.quick or not folder.is_dir():
        print(
            f"cloth: skipped, {'too long for a quick run' if options.quick else f'{folder} is absent'}", file=sys.stderr
        )
        return
    options.out.mkdir(parents=True, exist_ok=True)
    tracks = load_cloth(folder)
    rows = [row for name in SHOWN for row in compare(tracks, name)]
    save(options.out / "cloth.csv", rows)
    text = markdown(rows)
    (options.out / "cloth.md").write_text(text, encoding="utf-8")
    print(text)
