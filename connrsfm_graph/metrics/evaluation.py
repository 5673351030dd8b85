"""The errors of a reconstruction: the field's own measures and Euclidean ones, each under its own name.

Every frame is first aligned to the truth by a similarity. Only observed points with known truth count; a point that
the reconstruction does not hold is left out and lowers the coverage, it never counts as zero error.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.metrics.surface_normals import RECONSTRUCTION, TRUTH, surface_normals

MIN_POINTS = 4
"""Fewer points than this align with no error to speak of, so their frame is not evaluated."""


@dataclass(frozen=True)
class Evaluation:
    """Errors of one reconstruction; means and medians are over all evaluated points of all frames."""

    e3d_percent: float
    """The field's 3D error: mean of sqrt((dx^2 + dy^2 + dz^2) / 3) / extent, in percent. Per point it is the Euclidean
    distance divided by sqrt(3). The extent of a frame is the largest axis-aligned side of its truth."""
    shape_error_deg: float
    """Mean angle between the truth's normals and those of a spline refitted to the aligned points, in degrees."""
    shape_floor_deg: float
    """Shape error of the truth itself: what the smoother refit of a reconstruction costs on this data. A reconstruction
    cannot be expected to score below it."""
    rmse_3d: float
    """Root mean square Euclidean distance, in the unit of the truth."""
    rmse_3d_percent: float
    """Root mean square of Euclidean distance / extent, in percent."""
    median_3d_percent: float
    """Median of Euclidean distance / extent, in percent."""
    frobenius_percent: float
    """Mean over frames of |aligned - truth|_F / |truth - its centroid|_F, in percent: the "mean 3D error" of the dense
    data sets, with the truth centred so that it does not depend on the distance to the camera."""
    normal_error_deg: float | None
    """Mean angle between the truth's normals and the reconstruction's own ones, in degrees; None without such."""
    coverage: float
    """Share of the observed points with known truth that the reconstruction holds, 0 to 1."""
    per_frame: tuple[dict[str, Any], ...]
    """The same figures for every frame, with its index, number of points and scale; None where not evaluated."""

    def to_dict(self) -> dict[str, Any]:
        """Plain Python numbers for JSON; what could not be evaluated is None."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def evaluate(
    points: np.ndarray,
    truth: np.ndarray,
    visible: np.ndarray | None = None,
    *,
    normals: np.ndarray | None = None,
    true_normals: np.ndarray | None = None,
    image: np.ndarray | None = None,
) -> Evaluation:
    """Compare a reconstruction with the truth.

    Args:
        points: (F, P, 3) reconstruction in the camera frame of each image, in any unit; NaN where not recovered.
        truth: (F, P, 3) true points in the camera frame of each image; NaN where unknown.
        visible: (F, P) bool, which points count; all where absent.
        normals: (F, P, 3) the reconstruction's own unit normals towards the camera, NaN where unknown.
        true_normals: (F, P, 3) true normals towards the camera, NaN or zero where unknown; where absent they are those
            of a spline fitted to the truth.
        image: (F, P, 2) coordinates over which both splines are fitted; where absent each surface is taken over its
            own perspective projections. Needed for orthographic reconstructions.

    Raises:
        InputError: shapes do not match, nothing is left to compare, or a point lies behind the camera.
    """
    points, truth = np.asarray(points, dtype=float), np.asarray(truth, dtype=float)
    if truth.ndim != 3 or truth.shape[2] != 3:
        raise InputError(f"the truth has shape {truth.shape}, expected (frames, points, 3)")
    F, P, _ = truth.shape
    visible = np.ones((F, P), dtype=bool) if visible is None else np.asarray(visible, dtype=bool)
    for name, array, shape in (
        ("reconstructed points", points, (F, P, 3)),
        ("visibility", visible, (F, P)),
        ("normals", normals, (F, P, 3)),
        ("true normals", true_normals, (F, P, 3)),
        ("image coordinates", image, (F, P, 2)),
    ):
        if array is not None and np.shape(array) != shape:
            raise InputError(f"the {name} have shape {np.shape(array)}, the truth asks for {shape}")
    known = visible & np.isfinite(truth).all(axis=-1)
    held = known & np.isfinite(points).all(axis=-1)
    if image is not None:
        held &= np.isfinite(image).all(axis=-1)
    frames = [
        _Frame.compare(
            points[f],
            truth[f],
            held[f],
            None if normals is None else normals[f],
            None if true_normals is None else true_normals[f],
            None if image is None else image[f],
            f,
        )
        if held[f].sum() >= MIN_POINTS
        else None
        for f in range(F)
    ]
    compared = [frame for frame in frames if frame is not None]
    if not compared:
        raise InputError(f"no frame has {MIN_POINTS} reconstructed points with known truth, nothing can be evaluated")
    total = _summary(compared)
    n_known, n_held = known.sum(axis=1), held.sum(axis=1)
    per_frame = []
    for f, frame in enumerate(frames):
        figures = dict.fromkeys(total) if frame is None else _summary([frame])
        per_frame.append(
            {
                "frame": f,
                "points": int(n_held[f]),
                "coverage": _plain(n_held[f] / n_known[f]) if n_known[f] else None,
                "scale": None if frame is None else frame.scale,
                **{name: _plain(value) for name, value in figures.items()},
            }
        )
    return Evaluation(
        **total,
        coverage=float(n_held.sum() / n_known.sum()),
        per_frame=tuple(per_frame),
    )


@dataclass(frozen=True)
class _Frame:
    """Point-wise errors of one aligned frame."""

    distance: np.ndarray
    """(p,) Euclidean distances, in the unit of the truth."""
    extent: float
    spread: float
    """|truth - centroid|_F of the compared points."""
    scale: float
    shape_angle: np.ndarray
    """Degrees, of the points with a true normal."""
    floor_angle: np.ndarray
    """The same angles for the truth in place of the reconstruction."""
    normal_angle: np.ndarray | None

    @staticmethod
    def compare(
        points: np.ndarray,
        truth: np.ndarray,
        held: np.ndarray,
        normals: np.ndarray | None,
        true_normals: np.ndarray | None,
        image: np.ndarray | None,
        frame: int,
    ) -> _Frame:
        known_truth = truth[np.isfinite(truth).all(axis=-1)]
        points, truth = points[held], truth[held]
        scale, R, t = align_similarity(points, truth)
        aligned = scale * points @ R.T + t
        over = _project(points, "reconstruction", frame) if image is None else image[held]
        over_truth = _project(truth, "truth", frame) if image is None else over
        if true_normals is None:
            reference = surface_normals(over_truth, truth, TRUTH)
        else:
            reference = np.asarray(true_normals, dtype=float)[held]
        return _Frame(
            distance=np.linalg.norm(aligned - truth, axis=1),
            extent=float(np.ptp(known_truth, axis=0).max()),
            spread=float(np.linalg.norm(truth - truth.mean(axis=0))),
            scale=scale,
            shape_angle=_angle(surface_normals(over, aligned, RECONSTRUCTION), reference),
            floor_angle=_angle(surface_normals(over_truth, truth, RECONSTRUCTION), reference),
            normal_angle=None if normals is None else _angle(np.asarray(normals, dtype=float)[held] @ R.T, reference),
        )


def _summary(frames: list[_Frame]) -> dict[str, Any]:
    """The figures of `Evaluation` over the points of some frames."""
    distance = np.concatenate([frame.distance for frame in frames])
    relative = np.concatenate([frame.distance / frame.extent for frame in frames])
    own = [frame.normal_angle for frame in frames if frame.normal_angle is not None]
    return {
        "e3d_percent": float(100 * relative.mean() / np.sqrt(3)),
        "shape_error_deg": _mean([frame.shape_angle for frame in frames]),
        "shape_floor_deg": _mean([frame.floor_angle for frame in frames]),
        "rmse_3d": float(np.sqrt((distance**2).mean())),
        "rmse_3d_percent": float(100 * np.sqrt((relative**2).mean())),
        "median_3d_percent": float(100 * np.median(relative)),
        "frobenius_percent": float(100 * np.mean([np.linalg.norm(f.distance) / f.spread for f in frames])),
        "normal_error_deg": _mean(own) if own else None,
    }


def _project(points: np.ndarray, what: str, frame: int) -> np.ndarray:
    if (points[:, 2] <= 0).any():
        raise InputError(
            f"a point of the {what} lies behind the camera in frame {frame}; expected depths above 0, or an "
            "orthographic camera"
        )
    return points[:, :2] / points[:, 2:]


def _angle(normals: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Angles in degrees where both are known. atan2 keeps its accuracy near zero, where acos loses half the digits."""
    known = np.isfinite(normals).all(axis=-1) & np.isfinite(reference).all(axis=-1)
    known &= normals.any(axis=-1) & reference.any(axis=-1)  # a vector without length has no direction
    normals, reference = normals[known], reference[known]
    sine = np.linalg.norm(np.cross(normals, reference), axis=-1)
    return np.degrees(np.arctan2(sine, (normals * reference).sum(axis=-1)))


def _mean(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else float("nan")


def _plain(value: Any) -> Any:
    """JSON knows no NaN."""
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
