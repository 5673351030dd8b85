"""How far the truth itself is to be trusted: `python -m experiments truth`.

A depth camera errs by a smooth function of the image position that stays the same from image to image, and so does
depth that goes with a calibration that is off. A surface that keeps its lengths shows it: multiply every true depth by
exp(g(u, v)), so that points stay on their sight rays; lengths then agree better over the images if g undoes the error.
Here g is the cubic polynomial, the same for all images, that makes the lengths of the truth agree best. No
reconstruction has any part in it, and each half of the sequence is corrected by what the other half shows, so that g
cannot fit what belongs to single images. Whether the sensor or the calibration is to blame lengths do not tell.

The table holds, for every real data set, by how much the lengths of the truth differ from image to image, and the 3D
error of some methods, both as the truth is given and so corrected. Where the truth has no such error, little changes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from connrsfm_graph.methods import METHODS
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.progress import Progress
from connrsfm_graph.refine.mesh import surface_mesh
from connrsfm_graph.tracks import load_tracks
from experiments.cloth import truth_of
from experiments.study import VARIANTS, Options, save

SETS = {"T-shirt": "tshirt.npz", "KinectPaper": "kinect_paper.npz", "Flag": "flag.npz"}
SHOWN = ("default", "paper mode", "mlh", "mdh")
_DEGREE = 3
_GROSS = 0.01
"""Differences of log length beyond this count less: the truth of single points is noisy."""


@dataclass(frozen=True)
class Row:
    """One method on one data set."""

    data: str
    stretch_percent: float
    """Median absolute difference of a length from its mean over the images."""
    corrected_stretch_percent: float
    field_percent: float
    """Root mean square of the correction of depth."""
    method: str
    e3d_percent: float
    corrected_e3d_percent: float


def terms(points: np.ndarray) -> np.ndarray:
    """(F, P, 9) monomials of the image position up to the third degree, of points (F, P, 3)."""
    u, v = np.moveaxis(points[..., :2] / points[..., 2:], -1, 0)
    powers = [(a, b) for a in range(_DEGREE + 1) for b in range(_DEGREE + 1 - a) if a + b > 0]
    return np.stack([u**a * v**b for a, b in powers], axis=-1)


def corrected(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Points (F, P, 3) moved along their sight rays by the field of the given coefficients."""
    return points * np.exp(terms(points) @ coefficients)[..., None]


def stretch(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(F, E) log lengths of the edges (E, 2), less their means over the images and over the edges of each image."""
    log_length = np.log(np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=-1))
    log_length -= log_length.mean(axis=1, keepdims=True)
    return np.asarray(log_length - log_length.mean(axis=0))


def depth_field(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(9,) coefficients of the field that makes lengths of points (F, P, 3) agree best over the images."""

    def residual(coefficients: np.ndarray) -> np.ndarray:
        return stretch(corrected(points, coefficients), edges).ravel()

    start = np.zeros(terms(points[:1]).shape[-1])
    return np.asarray(least_squares(residual, start, loss="soft_l1", f_scale=_GROSS).x)


def cross_corrected(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Points (F, P, 3), each half of the images corrected by the field that the other half shows."""
    half = np.array_split(points, 2)
    return np.concatenate(
        [corrected(here, depth_field(there, edges)) for here, there in zip(half, half[::-1], strict=True)]
    )


def compare(data: str, path: Path, methods: Sequence[str] = SHOWN) -> list[Row]:
    """A row per method on one data set; points without truth in some image count in none."""
    tracks = load_tracks(path)
    points = truth_of(tracks)
    known = np.isfinite(points).all(axis=(0, 2)) & tracks.visible.all(axis=0)
    truth = points[:, known]
    mesh = surface_mesh(tracks.pixels[0, known], lambda edges: np.zeros(len(edges)))
    apart = np.linalg.norm(truth[:, mesh.edges[:, 0]] - truth[:, mesh.edges[:, 1]], axis=-1).min(axis=0)
    edges = mesh.edges[apart > 0.1 * np.median(apart)]
    better = cross_corrected(truth, edges)
    moved = np.log(better[..., 2] / truth[..., 2])
    moved -= moved.mean(axis=1, keepdims=True)
    rows = []
    for name in methods:
        method, config = VARIANTS[name]
        points = METHODS[method](tracks, config, Progress())[0].points[:, known]
        rows.append(
            Row(
                data,
                100.0 * float(np.median(np.abs(stretch(truth, edges)))),
                100.0 * float(np.median(np.abs(stretch(better, edges)))),
                100.0 * float(moved.std()),
                name,
                evaluate(points, truth).e3d_percent,
                evaluate(points, better).e3d_percent,
            )
        )
    return rows


def markdown(rows: Sequence[Row]) -> str:
    """One line per data set and method."""
    lines = [
        "### The truth of the real data: as given, and without an error of depth that stays with the image",
        "",
        "| data | lengths differ by % | corrected | depths moved by % | method | 3D error % | against the corrected |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        lengths = f"{row.stretch_percent:.2f} | {row.corrected_stretch_percent:.2f} | {row.field_percent:.2f}"
        errors = f"{row.e3d_percent:.3f} | {row.corrected_e3d_percent:.3f}"
        lines.append(f"| {row.data} | {lengths} | {row.method} | {errors} |")
    return "\n".join(lines) + "\n"


def measure(options: Options) -> None:
    """Write truth.csv and truth.md, of the data sets that are there; a quick run holds the default alone."""
    paths = {name: options.data / file for name, file in SETS.items()}
    there = {name: path for name, path in paths.items() if path.is_file()}
    if not there:
        print(f"truth: skipped, its data are not in {options.data}", file=sys.stderr)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    methods = SHOWN[:1] if options.quick else SHOWN
    rows = [row for name, path in there.items() for row in compare(name, path, methods)]
    save(options.out / "truth.csv", rows)
    text = markdown(rows)
    (options.out / "truth.md").write_text(text, encoding="utf-8")
    print(text)
